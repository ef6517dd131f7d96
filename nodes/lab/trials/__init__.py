"""Trials: many measured drives in a fair order, and what bags of drives say."""
