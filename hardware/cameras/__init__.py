"""Camera drivers with a common interface."""
