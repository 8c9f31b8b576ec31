"""Node `reconstruction`."""
