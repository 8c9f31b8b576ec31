"""The driver of the generator that modulates the laser."""
