"""What the laser and the stage do, over sensor time."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, field
from fractions import Fraction

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.clocks import MotionPlan
from eschorty_ros.core.modulation import Modulation

SINE_STEPS = 12
"""Steps of constant light in which a sine rises, and in which it falls."""


@dataclass(frozen=True)
class Gate:
    """A wave as exact integer edges with constant light between them.

    Parameters
    ----------
    modulation : Modulation
        ``on_edge_us`` must be known; edges agree with :meth:`Modulation.edge_us`. A sine is
        rendered in ``SINE_STEPS`` steps per flank, fewer where they would be below 1 us.
    clock_rate : Fraction
        Sensor time that passes per unit of the modulation's own time.

    Raises
    ------
    ArgumentError
        For an unknown edge.
    """

    modulation: Modulation
    clock_rate: Fraction = Fraction(1)
    _period: tuple[int, int] = field(init=False, repr=False, compare=False)
    _duty: tuple[int, int] = field(init=False, repr=False, compare=False)
    _origin_us: int = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.modulation.on_edge_us is None:
            raise ArgumentError("on_edge_us is None; give the sensor time of one rising edge")
        # Integers throughout: edges are asked for in the inner loop, Fraction objects are slow.
        period = 1_000_000 * self.clock_rate / Fraction(self.modulation.frequency_hz)
        object.__setattr__(self, "_period", period.as_integer_ratio())
        object.__setattr__(self, "_duty", Fraction(self.modulation.duty).as_integer_ratio())
        object.__setattr__(self, "_origin_us", self.modulation.on_edge_us)

    def rise_us(self, index: int) -> int:
        """Rising edge ``index``, us."""
        numerator, denominator = self._period
        return self._origin_us + _round_ratio(index * numerator, denominator)

    def fall_us(self, index: int) -> int:
        """Falling edge of period ``index``, us; at least 1 us from both rising edges."""
        numerator, denominator = self._period
        share, whole = self._duty
        fall = self._origin_us + _round_ratio(
            (index * whole + share) * numerator, whole * denominator
        )
        return max(self.rise_us(index) + 1, min(fall, self.rise_us(index + 1) - 1))

    def index(self, t_us: int) -> int:
        """Index of the period that holds ``t_us``."""
        numerator, denominator = self._period
        index = (t_us - self._origin_us) * denominator // numerator
        while self.rise_us(index) > t_us:
            index -= 1
        while self.rise_us(index + 1) <= t_us:
            index += 1
        return index

    def high(self, t_us: int) -> bool:
        """Whether the gate's signal is high at ``t_us``: from a rising to a falling edge."""
        return self._flank(t_us)[2]

    def flank_us(self, t_us: int) -> int:
        """First edge of the gate's signal after ``t_us``."""
        return self._flank(t_us)[1]

    def level(self, t_us: int) -> float:
        """Light at ``t_us``, 0 to 1."""
        begin_us, end_us, rising = self._flank(t_us)
        if self.modulation.waveform != "sine":
            return float(rising)
        steps = min(SINE_STEPS, end_us - begin_us)
        step = (t_us - begin_us) * steps // (end_us - begin_us)
        share = 0.5 - 0.5 * math.cos(math.pi * (step + 0.5) / steps)
        return share if rising else 1.0 - share

    def next_us(self, t_us: int) -> int:
        """First time after ``t_us`` at which the light changes."""
        begin_us, end_us, _ = self._flank(t_us)
        if self.modulation.waveform != "sine":
            return end_us
        length_us = end_us - begin_us
        steps = min(SINE_STEPS, length_us)
        step = (t_us - begin_us) * steps // length_us
        return begin_us - (-(step + 1) * length_us) // steps

    def _flank(self, t_us: int) -> tuple[int, int, bool]:
        """Begin and end of the part of the period that holds ``t_us``; whether it is the first."""
        index = self.index(t_us)
        fall = self.fall_us(index)
        if t_us < fall:
            return self.rise_us(index), fall, True
        return fall, self.rise_us(index + 1), False


def _round_ratio(numerator: int, denominator: int) -> int:
    """Nearest integer to a ratio, halves to even, as ``round`` of a Fraction."""
    whole, rest = divmod(numerator, denominator)
    up = 2 * rest > denominator or (2 * rest == denominator and whole % 2 == 1)
    return whole + up


class LaserTimeline:
    """When the laser is lit: a list of settings, each from its time on; dark before the first."""

    def __init__(self) -> None:
        self._times: list[int] = []
        self._gates: list[Gate | None] = []

    def set(
        self,
        t_us: int,
        on: bool,
        modulation: Modulation | None,
        clock_rate: Fraction = Fraction(1),
    ) -> None:
        """Switch from ``t_us`` on; replaces what was set for later times.

        Raises
        ------
        ArgumentError
            When ``on`` without a modulation, or without its edge.
        """
        if on and modulation is None:
            raise ArgumentError("the laser is on without a modulation; give one")
        gate = Gate(modulation, clock_rate) if on and modulation is not None else None
        keep = len([t for t in self._times if t < t_us])
        self._times[keep:] = [t_us]
        self._gates[keep:] = [gate]

    def level(self, t_us: int) -> float:
        """Light of the laser at ``t_us``, 0 to 1."""
        gate = self._gate(t_us)
        return 0.0 if gate is None else gate.level(t_us)

    def rises(self, t_us: int) -> bool:
        """Whether ``t_us`` is a rising edge."""
        gate = self._gate(t_us)
        return gate is not None and gate.rise_us(gate.index(t_us)) == t_us

    def edges(self, begin_us: int, end_us: int) -> list[tuple[int, bool]]:
        """Edges of the gate's signal from ``begin_us`` to before ``end_us``: time, rising."""
        found: list[tuple[int, bool]] = []
        t_us, high = begin_us - 1, self._high(begin_us - 1)
        while True:
            gate = self._gate(t_us)
            k = bisect_right(self._times, t_us)
            ends = self._times[k : k + 1]
            if gate is not None:
                ends.append(gate.flank_us(t_us))
            t_us = min(ends, default=end_us)
            if t_us >= end_us:
                return found
            if self._high(t_us) != high:
                high = not high
                found.append((t_us, high))

    def next_us(self, t_us: int) -> int | None:
        """First time after ``t_us`` at which the laser may change, ``None`` for never."""
        k = bisect_right(self._times, t_us)
        candidates = self._times[k : k + 1]
        gate = self._gate(t_us)
        if gate is not None:
            candidates.append(gate.next_us(t_us))
        return min(candidates, default=None)

    def forget_before(self, t_us: int) -> None:
        """Drop settings that no time from ``t_us`` on needs."""
        k = max(bisect_right(self._times, t_us) - 1, 0)
        del self._times[:k], self._gates[:k]

    def _high(self, t_us: int) -> bool:
        gate = self._gate(t_us)
        return gate is not None and gate.high(t_us)

    def _gate(self, t_us: int) -> Gate | None:
        k = bisect_right(self._times, t_us) - 1
        return self._gates[k] if k >= 0 else None


class StageTimeline:
    """Where the stage is: a list of motion plans, each from its time on; at 0 before the first."""

    def __init__(self) -> None:
        self._times: list[int] = []
        self._plans: list[tuple[MotionPlan, int, Fraction]] = []

    def set(
        self, t_us: int, plan: MotionPlan, zero_ns: int, clock_rate: Fraction = Fraction(1)
    ) -> None:
        """Follow ``plan`` from ``t_us`` on.

        The plan's clock read ``zero_ns`` at sensor time 0; ``clock_rate`` is the sensor time that
        passes per unit of the plan's.
        """
        keep = len([t for t in self._times if t < t_us])
        self._times[keep:] = [t_us]
        self._plans[keep:] = [(plan, zero_ns, clock_rate)]

    def state(self, t_us: int) -> tuple[float, float]:
        """Position (mm) and velocity (mm/s) at ``t_us``."""
        k = bisect_right(self._times, t_us) - 1
        if k < 0:
            return 0.0, 0.0
        plan, zero_ns, rate = self._plans[k]
        position, velocity = plan.state(zero_ns + t_us * 1000 * rate.denominator // rate.numerator)
        return float(position), float(velocity)

    def forget_before(self, t_us: int) -> None:
        """Drop plans that no time from ``t_us`` on needs."""
        k = max(bisect_right(self._times, t_us) - 1, 0)
        del self._times[:k], self._plans[:k]
