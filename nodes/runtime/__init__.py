"""The runtime that all nodes share: messages, topics, bus, clock, loop, process, configuration."""
