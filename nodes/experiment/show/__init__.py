"""Presentation of attacks in drives, and of objects in pictures."""
