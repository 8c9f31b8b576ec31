"""Camera, laser and stage: what a device must offer, and the drivers that offer it."""
