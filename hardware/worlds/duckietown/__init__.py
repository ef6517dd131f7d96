"""Duckietown as a world, in a separate process and environment: ``advnerf world install duckietown``."""
