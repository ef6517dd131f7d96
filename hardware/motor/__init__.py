"""The VESC motor controller: serial protocol, settings, limits, odometry."""
