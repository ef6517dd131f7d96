"""Implementation of ``advnerf carla ...``: check a server, photograph a junction, drive it with the expert."""
