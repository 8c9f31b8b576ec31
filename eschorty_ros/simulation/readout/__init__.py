"""Readout of the sensor: row by row, at a limited rate."""

from eschorty_ros.simulation.readout.readout import EventRate, Readout, ReadoutParameters

__all__ = ["EventRate", "Readout", "ReadoutParameters"]
