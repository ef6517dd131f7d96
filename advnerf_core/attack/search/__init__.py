"""Searches for an attack: the common loop, and one module for each method."""
