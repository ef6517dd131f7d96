"""Calibration fits, and the dated YAML files that they write."""
