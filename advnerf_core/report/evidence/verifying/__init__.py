"""The checks of ``advnerf verify``, one kind in each file. Each yields what is wrong, in words."""
