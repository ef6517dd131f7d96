"""Recorded drives again: in lockstep, against golden results, with an attack."""
