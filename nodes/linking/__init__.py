"""The link between two hosts: keys, doors, and the offset of their clocks."""
