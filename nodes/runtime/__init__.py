"""What all nodes share: messages, topics, bus, clock, node loop, bags, launch."""
