"""Schema of experiment files."""
