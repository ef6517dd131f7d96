"""ZED stereo cameras without their SDK, through V4L2."""
