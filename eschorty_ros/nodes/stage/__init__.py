"""Node `stage`."""
