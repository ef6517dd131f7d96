"""Measures the room from bags and the running launch: path, fence, targets, and the current poses of subjects."""
