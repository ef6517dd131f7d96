"""What is searched: colours of placed objects, the picture on a display."""
