"""An emulated UTG900E-like waveform generator."""
