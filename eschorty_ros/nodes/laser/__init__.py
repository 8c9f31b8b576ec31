"""Node `laser`."""
