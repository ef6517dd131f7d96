"""Experiments: stages, searches, deployed drives, cells, and their reports."""
