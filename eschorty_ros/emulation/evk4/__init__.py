"""An emulated Prophesee EVK4."""
