"""The link between two hosts: keys, doors (ports with access control), and the offset of their clocks."""
