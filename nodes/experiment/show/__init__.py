"""What shows a texture in a drive, and how an object gets into pictures."""
