"""The checks of ``advnerf verify``, one kind in each file. Each yields its problems as text."""
