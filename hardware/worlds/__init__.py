"""Places that are driven: the lab, the junction, CARLA."""
