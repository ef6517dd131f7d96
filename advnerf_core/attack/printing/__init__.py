"""Attacks on paper: a texture at its true size, as a PDF in tiles or as one PNG."""
