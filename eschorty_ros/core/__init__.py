"""Range model, decoding, reconstruction: numpy and numba; no ROS, no hardware, no clock."""
