"""Ray casting, volume rendering, occupancy and depth-ordered composition."""
