"""Bridge from a companion service to ROS 2."""
