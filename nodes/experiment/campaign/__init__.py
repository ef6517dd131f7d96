"""Campaigns: many cells (scenario, placement, victim, method, seed) over cores and machines, and the table they make."""
