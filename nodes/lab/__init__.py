"""What a person at the lab does: import scenes, train policies, calibrate, run trials."""
