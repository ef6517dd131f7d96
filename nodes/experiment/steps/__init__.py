"""The steps of an experiment: from photographs to deployed drives."""
