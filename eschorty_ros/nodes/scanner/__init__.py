"""Node `scanner`."""
