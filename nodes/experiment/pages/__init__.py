"""What a finished or running experiment shows."""
