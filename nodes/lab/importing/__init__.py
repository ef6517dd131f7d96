"""Makes posed images from recordings: videos, photographs, bags."""
