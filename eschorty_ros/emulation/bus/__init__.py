"""Emulated USB buses and serial ports, in this process or in another."""
