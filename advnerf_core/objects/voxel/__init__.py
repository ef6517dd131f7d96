"""Objects as voxel grids: from meshes, cut-out photographs and generators."""
