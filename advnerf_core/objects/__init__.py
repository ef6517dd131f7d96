"""Attackable objects: made from meshes, photographs or generators, kept in files, placed in scenes."""
