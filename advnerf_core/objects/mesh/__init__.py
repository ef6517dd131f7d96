"""Attacks on textured meshes: colours and shapes by differentiable rendering, with Mitsuba."""
