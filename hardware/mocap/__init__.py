"""Motion capture: VICON's Tracker stream, and other systems through the library motioncapture."""
