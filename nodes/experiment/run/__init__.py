"""Cells: running, registering and publishing them."""
