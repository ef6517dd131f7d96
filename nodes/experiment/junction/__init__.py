"""The paper's first scene: a car at a junction, one goal-conditioned policy, three drives, five objects. Stages as in `nodes.experiment`."""
