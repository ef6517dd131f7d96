"""Bags (recordings): writing, reading, checking, repairing and playing."""
