"""Posed images out of what a person has recorded: videos, photographs, bags."""
