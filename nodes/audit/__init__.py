"""The audit: can an object drive a given policy off its path in a given place? It writes an experiment and runs it under a schedule."""
