"""The statistics of published results: outcomes in metres, clustered intervals, and tests that are few and registered beforehand."""
