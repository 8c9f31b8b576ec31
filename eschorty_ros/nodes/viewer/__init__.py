"""Node `viewer`."""
