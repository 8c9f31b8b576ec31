"""Devices that exist in memory: what a driver's bytes meet instead of a camera, laser or stage."""
