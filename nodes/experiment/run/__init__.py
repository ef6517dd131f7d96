"""Cells: running them, registering, publishing."""
