"""ROS 2 nodes: convert in, call the core, convert out."""
