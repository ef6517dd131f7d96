"""Policies from recordings: frames of bags and of foreign logs, training on them, and how well a policy predicts them."""
