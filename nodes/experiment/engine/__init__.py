"""Steps are kept, resumed, and their progress told."""
