"""Duckietown as a world, in a process and an environment of its own: ``advnerf world install duckietown``."""
