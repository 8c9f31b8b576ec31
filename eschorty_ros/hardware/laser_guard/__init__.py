"""The process that owns the generator and outlives the laser node."""
