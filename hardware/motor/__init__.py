"""The VESC motor controller: bytes, settings, limits, odometry."""
