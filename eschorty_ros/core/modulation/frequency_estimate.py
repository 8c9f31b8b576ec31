"""The modulation that a stream of events shows, by the events' times in steps of 10 us."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.modulation.modulation import FREQUENCY_MAX_HZ, FREQUENCY_MIN_HZ, Modulation
from eschorty_ros.core.modulation.phase_estimate import estimate_phase

_BIN_US = 10
_BINS = 200_000
_WINDOW_US = _BINS * _BIN_US
# Least steps of the spectrum per turn over the window, so that a parabola finds a line's place.
_STEPS = 2.5
# Power of a line over the mean of the power between the lines.
_LINE_MIN = 50.0
_STRONG = 0.5
# Power of a line over that beside it, which a stronger one leaks.
_BESIDE_MIN = 4.0
# Turns between two frequencies over the window, and their relative difference: clocks differ less.
_TURNS_MAX = 0.25
_CLOCKS_MAX = 1e-3
# Fewest turns in the window: the light's switching on and off has power at few.
_TURNS_MIN = 8
# Parts of the window: bursts with the fewest turns are in half of them.
_PARTS = 2 * _TURNS_MIN
# Turns over which the power of one frequency falls off.
_LOBE = 2.0
# ON events that show the phase, evenly spread.
_PHASE_EVENTS = 1 << 14
# Least vector strength of the events of a polarity that show the duty cycle, as a line that moves
# has others in between, and steps in a sum.
_STRENGTH_MIN = 0.8
_STEPS_IN_SUM = 10


class FrequencyEstimate:
    """Counts events in steps of 10 us and finds the frequency of their bursts.

    The busiest 2 s count. Memory does not depend on the number of events.

    Examples
    --------
    >>> t_us = np.arange(100_000) // 1000 * 10_000 + np.arange(100_000) % 1000
    >>> estimate = FrequencyEstimate()
    >>> estimate.add(t_us, np.ones(t_us.size, np.uint8))
    >>> print(f"{estimate.frequency_hz(200.0):.2f} Hz, {estimate.frequency_hz(100.02):.2f} Hz")
    100.00 Hz, 100.02 Hz
    """

    def __init__(self) -> None:
        self._begin_us: int | None = None
        self._busiest_us = 0
        self._counts = self._busiest = np.zeros((2, _BINS), np.int64)

    def add(self, t_us: NDArray[np.int64], polarity: NDArray[np.uint8]) -> None:
        """Add the next events, in time order; ``polarity`` is 1 for ON."""
        while t_us.size:
            if self._begin_us is None:
                self._begin_us, self._counts = int(t_us[0]), np.zeros((2, _BINS), np.int64)
            size = int(np.searchsorted(t_us, self._begin_us + _WINDOW_US))
            place = (t_us[:size] - self._begin_us) // _BIN_US + polarity[:size] * np.int64(_BINS)
            np.add.at(self._counts.reshape(-1), place, 1)
            if self._counts.sum() >= self._busiest.sum():
                self._busiest, self._busiest_us = self._counts, self._begin_us
            t_us, polarity = t_us[size:], polarity[size:]
            if t_us.size:
                self._begin_us = None

    def edge_us(self, modulation: Modulation) -> int | None:
        """Return a rising edge, from the ON events alone: their burst begins there, or later.

        ``None`` where they have no burst at the frequency of ``modulation``.
        """
        t_us = self._busiest_us + np.repeat(np.arange(_BINS) * _BIN_US, self._busiest[1])
        t_us = t_us[:: max(t_us.size // _PHASE_EVENTS, 1)]
        if not t_us.size:
            return None
        estimate = estimate_phase(t_us, np.ones(t_us.size, np.uint8), modulation)
        return estimate.edge_us if estimate.found else None

    def duty(self, modulation: Modulation) -> float | None:
        """Return the mean time from ON to OFF events, in periods of ``modulation``.

        ``None`` where most events of one polarity are not in a burst at its frequency.
        """
        counts = self._busiest.reshape(2, -1, _STEPS_IN_SUM).sum(axis=2)
        turns = np.arange(counts.shape[1]) * (_STEPS_IN_SUM * _BIN_US / modulation.period_us)
        vectors = counts @ np.exp(-2j * np.pi * turns)
        if np.any(np.abs(vectors) <= _STRENGTH_MIN * counts.sum(axis=1)):
            return None
        off, on = np.angle(vectors) / (2.0 * np.pi)
        return float((on - off) % 1.0)

    def frequency_hz(self, expected_hz: float) -> float | None:
        """Return the frequency of the bursts, ``expected_hz`` where the events agree with it.

        ``None`` when no frequency stands out. Bursts show multiples of their frequency, too: it is
        the lowest one that stands out. A flash of another light, or a jolt, may be one burst of all
        pixels: where the events do not agree, it is left out.
        """
        used = np.flatnonzero(self._busiest.any(axis=0))
        if used.size < _TURNS_MIN:
            return None
        counts = self._busiest[:, used[0] : used[-1] + 1]
        found_hz = _frequency_hz(counts, expected_hz)
        if found_hz in {None, expected_hz}:
            return found_hz
        even_hz = _frequency_hz(_without_flash(counts), expected_hz)
        return found_hz if even_hz is None else even_hz


def _without_flash(counts: NDArray[np.int64]) -> Array:
    """Return the counts of each polarity, of the two busiest parts as many as of the third.

    One burst is in two parts at most.
    """
    starts = np.arange(_PARTS) * counts.shape[1] // _PARTS
    parts = np.maximum(np.add.reduceat(counts, starts, axis=1), 1)
    most = np.sort(parts, axis=1)[:, -3:-2]
    lengths = np.diff(starts, append=counts.shape[1])
    return counts * np.repeat(np.minimum(most / parts, 1.0), lengths, axis=1)


def _frequency_hz(counts: Array | NDArray[np.int64], expected_hz: float) -> float | None:
    """Return the frequency of counts by polarity and step; see `FrequencyEstimate`."""
    span_s = counts.shape[1] * _BIN_US * 1e-6
    length = 1 << int(np.ceil(np.log2(_STEPS * counts.shape[1])))
    step_hz = 1e6 / (length * _BIN_US)
    # A window with soft ends keeps a strong light from hiding a weak one.
    soft = (counts - counts.mean(axis=1, keepdims=True)) * np.hanning(counts.shape[1])
    spectrum = np.fft.rfft(soft, length, axis=1)
    power = (np.abs(spectrum) ** 2).sum(axis=0)
    low = max(round(0.9 * FREQUENCY_MIN_HZ / step_hz), 1)
    high = round(FREQUENCY_MAX_HZ / step_hz)
    strongest = float(power[low:high].max())
    noise = _LINE_MIN * float(np.median(power[low:high]))
    if strongest <= noise:
        return None
    reach_hz, inner_hz, outer_hz = (k / span_s for k in (_TURNS_MAX, _LOBE, 1.5 * _LOBE))

    def highest(from_hz: float, to_hz: float) -> float:
        near = power[max(int(from_hz / step_hz), 0) : int(to_hz / step_hz) + 2]
        return float(near.max(initial=0.0))

    def at_line(frequency_hz: float) -> float:
        return highest(frequency_hz - reach_hz, frequency_hz + reach_hz)

    def stands_out(frequency_hz: float) -> bool:
        below = highest(frequency_hz - outer_hz, frequency_hz - inner_hz)
        above = highest(frequency_hz + inner_hz, frequency_hz + outer_hz)
        return at_line(frequency_hz) >= max(noise, _BESIDE_MIN * max(below, above))

    peak = low + int(np.argmax(power[low:high] >= _STRONG * strongest))
    while power[peak + 1] > power[peak]:
        peak += 1
    before, at, after = np.log(power[peak - 1 : peak + 2])
    found_hz = float(peak + 0.5 * (before - after) / (before - 2.0 * at + after)) * step_hz
    if found_hz * span_s < _TURNS_MIN:
        return None
    apart_hz = abs(expected_hz - found_hz)
    tolerance_hz = max(reach_hz, _CLOCKS_MAX * expected_hz)
    if apart_hz <= tolerance_hz:
        return expected_hz
    if apart_hz <= inner_hz or not stands_out(expected_hz):
        return found_hz
    # Another light may blink as well: then the multiples between the two are weak.
    multiple = round(expected_hz / found_hz)
    of_found = abs(expected_hz - multiple * found_hz) <= multiple * tolerance_hz
    strong = _STRONG * strongest
    between = all(at_line(order * found_hz) >= strong for order in range(2, multiple))
    return found_hz if of_found and between else expected_hz
