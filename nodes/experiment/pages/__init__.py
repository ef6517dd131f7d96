"""Reports of finished experiments."""
