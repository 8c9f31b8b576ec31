"""Event camera drivers."""
