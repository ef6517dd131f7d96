"""Worlds that are driven: found by name, driven by the expert, and held against their contract."""
