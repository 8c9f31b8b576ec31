"""Figures and accuracy figures of a scan."""
