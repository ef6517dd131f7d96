"""Device drivers, one per file, and the simulated lab that uses the same protocols."""
