"""Posed images in and out: data sets, transforms.json, lenses, videos."""
