"""The streaming instrument without ROS: packets in, profiles and scans out."""
