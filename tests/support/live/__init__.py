"""The live stack at work, for campaigns, benchmarks and tests: its lab with faults, its operator, its page, and bad networks."""
