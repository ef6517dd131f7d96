"""ROS 2 without ROS: topics over DDS with the names, types and QoS of ROS 2.

`routes` says what is carried, `conversions` changes types, `answers` decides which commands count, `dds` owns the sockets.
"""
