"""Decides whether the car may move. Pure: time and messages come as arguments."""
