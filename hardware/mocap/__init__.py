"""Motion capture: VICON's Tracker stream, and other systems by the library motioncapture."""
