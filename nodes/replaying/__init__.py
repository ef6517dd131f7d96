"""Replays recorded drives: in lockstep, compared with golden bags, and with an attack."""
