"""Recordings: writing, reading, checking, repairing, playing."""
