"""Searches for an attack: the loop that all share, and one module for each method."""
