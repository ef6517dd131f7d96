"""The learned scene, its training, and the surrogate built from it."""
