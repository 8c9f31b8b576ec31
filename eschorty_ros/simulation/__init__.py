"""A simulated bench: scene, event pixels, laser and stage, with the truth known."""
