"""All emulated devices around one simulated world."""
