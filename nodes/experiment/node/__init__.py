"""Implementation of the attack node's searches."""
