"""Attacks on request: from a file or a message to a problem, a search and an attack file."""
