"""Search spaces: colours of placed objects, their places and shapes, the picture on a display."""
