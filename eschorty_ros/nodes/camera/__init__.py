"""Node `camera`."""
