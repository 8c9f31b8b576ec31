"""An emulated Thorlabs stage controller."""
