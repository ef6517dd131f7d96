"""What the attack node needs."""
