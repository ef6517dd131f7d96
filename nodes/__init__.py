"""ROS-style nodes, one process per file, connected by ZeroMQ."""
