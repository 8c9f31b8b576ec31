"""Where the counts of a line's footprint are symmetric: its centre, and whether it has one.

Pixels are counted by their events, the first axis, and by their place on the line: their distance
from its row, in eighths of a row.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import kernel

# Places per row.
_PLACES = 8
# Places to either side where lines that are all cut may have their centre, and those that are to be
# seen on both sides of it.
_CENTRES = 8 * _PLACES
_BOTH_SIDES_MIN = 2 * _PLACES
# Weights of near places, which fall linearly, and their sum of squares over the sum: for the
# variance of a mean.
_WEIGHTS = _PLACES - np.abs(np.arange(1.0 - _PLACES, _PLACES))
_NEAR_PLACES = float((_WEIGHTS * _WEIGHTS).sum() / _WEIGHTS.sum())
# Variance over that by chance of counts that show a structure, the asymmetry of a centre, and its
# largest error.
_STRUCTURE_MIN = 4.0
_SYMMETRIC = 0.1
_ERROR_MAX = 2 * _PLACES
# Variance of counts that are all the same, which vary by less than a whole one.
_COUNT2 = 1.0 / 12.0
# Share of the largest mean count at the ends of a footprint, and the distance of its mean from the
# middle of these that is a fault: up to 0.2 on symmetric lines, 0.3 to 5 where one side is lost.
_END_SHARE = 0.2
_LOPSIDED_PX = 0.25


class _Counts(NamedTuple):
    """By place the number of pixels, the mean of their events and its variance for one pixel."""

    pixels: NDArray[np.float64]
    mean: NDArray[np.float64]
    variance: NDArray[np.float64]


@kernel(_nrt=False)
def _asymmetry(counts, centre):
    """Return how different mean counts are on either side of a centre, over how much they vary.

    It is 0 for a symmetric footprint, 1 for an unrelated one, and infinite where few places are
    seen on both sides or counts vary no more there than by chance.
    """
    pixels, mean, variance = counts.pixels, counts.mean, counts.variance
    reach = min(centre, pixels.size - 1 - centre)
    total, both = 0.0, 0
    for b in range(1, reach + 1):
        if min(pixels[centre - b], pixels[centre + b]) > 0.0:
            total += mean[centre - b] + mean[centre + b]
            both += 1
    if both < _BOTH_SIDES_MIN:
        return np.inf
    usual, differences, variations, chance = 0.5 * total / both, 0.0, 0.0, 0.0
    for b in range(1, reach + 1):
        i, j = centre - b, centre + b
        if min(pixels[i], pixels[j]) > 0.0:
            weight = pixels[i] * pixels[j] / (pixels[i] + pixels[j])
            differences += weight * (mean[i] - mean[j]) ** 2
            variations += weight * ((mean[i] - usual) ** 2 + (mean[j] - usual) ** 2)
            chance += weight * (variance[i] / pixels[i] + variance[j] / pixels[j])
    return differences / variations if variations > _STRUCTURE_MIN * chance else np.inf


@kernel
def _near_places(values):
    """Return the weighted sums of values over a row on either side."""
    return np.convolve(values, _WEIGHTS)[_PLACES - 1 : 1 - _PLACES]


@kernel
def _mean_counts(pixels):
    """Return the counts by place of pixels by their events."""
    number, events, squares = np.zeros((3, pixels.shape[1]))
    for k in range(pixels.shape[0]):
        number += pixels[k]
        events += k * pixels[k]
        squares += k * k * pixels[k]
    number = _near_places(number)
    known = np.maximum(number, 1.0)
    mean = _near_places(events) / known
    variance = _near_places(squares) / known - mean * mean + _COUNT2
    return _Counts(number / _NEAR_PLACES, mean, variance)


@kernel
def _centre(pixels):
    """Return the place about which the mean counts by place are symmetric, and its error.

    Rows of lines that are all cut are off by about as much: their footprint has its centre there,
    and no places beyond the sensor. The error is the distance to the furthest symmetric place. It
    is -1, and the centre the middle, where there are none or many.
    """
    middle, counts = pixels.shape[1] // 2, _mean_counts(pixels)
    best, least, error = middle, _SYMMETRIC, -1
    tried = range(middle - _CENTRES, middle + _CENTRES + 1)
    for centre in tried:
        asymmetry = _asymmetry(counts, centre)
        if asymmetry < least:
            best, least, error = centre, asymmetry, 1
    for centre in tried:
        if error > 0 and _asymmetry(counts, centre) < _SYMMETRIC:
            error = max(error, abs(centre - best))
    return (best, error) if error <= _ERROR_MAX else (middle, -1)


@kernel
def _is_asymmetric(pixels, lit_displacement_px):
    """Return whether the mean of the counts by place is not in the middle of their ends.

    Of a line that moves while it is lit, rows at one end may have all events and as many at the
    other none: that is half of its displacement.
    """
    mean = _mean_counts(pixels).mean
    low = high = np.argmax(mean)
    least = _END_SHARE * mean[low]
    while low > 0 and mean[low - 1] > least:
        low -= 1
    while high < mean.size - 1 and mean[high + 1] > least:
        high += 1
    places = np.arange(low, high + 1)
    centre = (places * mean[low : high + 1]).sum() / max(mean[low : high + 1].sum(), 1e-9)
    return abs(centre - 0.5 * (low + high)) > (_LOPSIDED_PX + 0.5 * lit_displacement_px) * _PLACES
