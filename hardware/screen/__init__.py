"""Screens that show an attack in the room."""
