"""Range model, event decoding and reconstruction: numpy and numba, no ROS, no hardware, no clock."""
