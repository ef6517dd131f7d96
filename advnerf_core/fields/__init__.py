"""Learned fields: hash-grid scenes and voxel-grid objects."""
