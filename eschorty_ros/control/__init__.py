"""What a scan and a calibration do step by step, and when the laser may be on. No ROS."""
