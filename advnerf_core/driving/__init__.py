"""Vehicle dynamics, reference path, expert, policy, imitation learning and the one rollout loop."""
