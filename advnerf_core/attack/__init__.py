"""The adjoint, the optimisers, the baselines and the attack file."""
