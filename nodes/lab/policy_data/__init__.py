"""Policies from recordings: frames of bags and foreign logs, training on them, and evaluation of a policy on them."""
