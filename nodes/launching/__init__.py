"""Launch files, the supervisor of a launch, and queries to a running launch."""
