"""Experiments: stages, searches, deployed drives, campaigns of cells, and their reports."""
