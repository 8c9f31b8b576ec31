"""Random numbers that belong to a pixel and a time, whoever asks and when."""

from __future__ import annotations

import math

import numpy as np

from eschorty_ros.core.base.kernel import kernel


@kernel
def _mix(value):
    """One round of splitmix64: 64 well mixed bits from a counter."""
    value = np.uint64(value) + np.uint64(0x9E3779B97F4A7C15)
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


@kernel
def _bits(t_us, column, row, seed, purpose):
    """64 random bits that belong to what a pixel does at a time."""
    place = np.uint64((column << 12) | row) * np.uint64(0xD6E8FEB86659FD93)
    salt = np.uint64(purpose) * np.uint64(0xA0761D6478BD642F)
    return _mix((place ^ np.uint64(seed)) + salt + np.uint64(np.int64(t_us * 1024.0)))


@kernel
def _gaussian(bits):
    """Sum of four 16-bit numbers, as a Gaussian of standard deviation 1 cut at 3.5."""
    low = np.uint64(0x0000FFFF0000FFFF)
    pairs = (bits & low) + ((bits >> np.uint64(16)) & low)
    total = np.int64(pairs & np.uint64(0xFFFFFFFF)) + np.int64(pairs >> np.uint64(32))
    return (np.float64(total) - 131070.0) * (math.sqrt(3.0) / 65536.0)


@kernel
def _uniform(bits):
    """Return number between 0 and 1, neither included."""
    return (np.float64(bits >> np.uint64(11)) + 0.5) * 2.0**-53
