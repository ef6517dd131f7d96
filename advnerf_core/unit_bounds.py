"""Bounds that only another unit exceeds: no car, lens or test track comes near them."""

MOST_LENGTH_M, MOST_SPEED_MPS, MOST_LAG_S = 20.0, 50.0, 5.0
