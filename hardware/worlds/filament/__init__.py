"""The lab drawn by another renderer, MuJoCo 4's Filament, in a process and an environment of its own: ``advnerf world install filament``."""
