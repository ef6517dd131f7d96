"""Worlds: found by name, driven by the expert, and checked against their contract."""
