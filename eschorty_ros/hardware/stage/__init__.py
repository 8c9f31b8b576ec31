"""Linear stage driver."""
