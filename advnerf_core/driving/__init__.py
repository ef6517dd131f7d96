"""Vehicle dynamics, reference path, expert, cross-track error, and the one rollout loop."""
