"""Cameras of the Linux kernel (V4L2)."""
