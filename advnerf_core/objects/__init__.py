"""Attackable objects: made from meshes, photographs or generators, stored in files, placed in scenes."""
