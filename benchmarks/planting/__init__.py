"""Changes that somebody could make to what is published, planted into a copy of it; see `benchmarks.planted_changes`."""
