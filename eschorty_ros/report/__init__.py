"""Figures, pages and the accuracy of scans and calibrations."""
