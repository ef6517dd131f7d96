"""Duckietown as a world, in a separate process and environment: ``advnerf scene world install duckietown``."""
