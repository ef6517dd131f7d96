"""What the calibrations of `calibration` need, taken out of bags, folders and running launches."""
