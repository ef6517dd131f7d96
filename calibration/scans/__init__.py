"""Readers of posed images from scanning software, one module for each format."""
