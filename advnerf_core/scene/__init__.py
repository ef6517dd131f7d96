"""Posed image sets, scene training, and the surrogate built from a trained scene."""
