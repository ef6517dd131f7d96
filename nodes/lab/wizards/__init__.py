"""Prepares the inputs of the calibrations from bags, folders and running launches."""
