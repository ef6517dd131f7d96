"""Implementation of ``advnerf scene carla ...``: check a server, photograph a junction, drive it with the expert."""
