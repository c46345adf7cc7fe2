"""A run of dimos as a node of ROS 2."""
