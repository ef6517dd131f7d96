"""Devices of the simulated lab that speak the real protocols."""
