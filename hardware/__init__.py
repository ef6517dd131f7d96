"""One device per file, and the simulated lab that speaks their protocols."""
