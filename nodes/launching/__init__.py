"""Launch files, the supervisor of a launch, and what a person asks a running one."""
