"""Scenes of Gaussians (3D Gaussian splatting): files, checks, rendering on the CPU, and baking."""
