"""A place that is known by posed photographs alone."""
