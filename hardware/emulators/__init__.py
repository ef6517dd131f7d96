"""Emulated devices of the simulated lab that use the real protocols."""
