"""Laser generator driver and its guard."""
