"""Trials: series of measured drives in balanced order, and the evaluation of drives in bags."""
