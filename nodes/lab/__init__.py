"""Tools for the lab: import scenes, train policies, calibrate, run trials."""
