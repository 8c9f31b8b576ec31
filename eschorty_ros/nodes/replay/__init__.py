"""Node `replay`."""
