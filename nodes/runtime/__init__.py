"""What every node is made of: messages, topics, bus, clock, loop, process, configuration."""
