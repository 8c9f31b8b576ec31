"""The steps of a scan and of a calibration, and the conditions of laser light. No ROS."""
