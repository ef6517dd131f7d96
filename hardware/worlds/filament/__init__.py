"""The lab drawn by another renderer, MuJoCo 4's Filament, in a separate process and environment: ``advnerf scene world install filament``."""
