"""Settings of the laser, the stage and the sensor over sensor time."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Generic, NamedTuple, TypeVar

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.clocks import MotionPlan
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.simulation.pixels import Biases
from eschorty_ros.simulation.readout import EventRate

Setting = TypeVar("Setting")

SINE_STEPS = 12
"""Steps of constant light in which a sine rises, and in which it falls."""


class _Flank(NamedTuple):
    """Begin and end of a half-period, and whether the gate's signal is high in it."""

    begin_us: int
    end_us: int
    high: bool


@dataclass(frozen=True)
class Gate:
    """A wave as exact integer edges with constant light between them.

    Raises ``ArgumentError`` for an unknown edge.
    """

    modulation: Modulation
    """``on_edge_us`` must be known; edges agree with :meth:`Modulation.edge_us`. A sine is rendered
    in ``SINE_STEPS`` steps per flank, fewer where they would be below 1 us."""
    clock_rate: Fraction = Fraction(1)
    """Sensor time that passes per unit of the modulation's own time."""
    _period: tuple[int, int] = field(init=False, repr=False, compare=False)
    _duty: tuple[int, int] = field(init=False, repr=False, compare=False)
    _origin_us: int = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.modulation.on_edge_us is None:
            raise ArgumentError("on_edge_us is None; give the sensor time of one rising edge")
        # Integers throughout: edges are computed in the inner loop, where Fraction is slow.
        period = 1_000_000 * self.clock_rate / Fraction(self.modulation.frequency_hz)
        object.__setattr__(self, "_period", period.as_integer_ratio())
        object.__setattr__(self, "_duty", Fraction(self.modulation.duty).as_integer_ratio())
        object.__setattr__(self, "_origin_us", self.modulation.on_edge_us)

    def rise_us(self, index: int) -> int:
        """Return rising edge ``index``, us."""
        numerator, denominator = self._period
        return self._origin_us + _round_ratio(index * numerator, denominator)

    def fall_us(self, index: int) -> int:
        """Return the falling edge of period ``index``, us; at least 1 us from both rising edges."""
        numerator, denominator = self._period
        share, parts = self._duty
        fall = self._origin_us + _round_ratio(
            (index * parts + share) * numerator, parts * denominator
        )
        return max(self.rise_us(index) + 1, min(fall, self.rise_us(index + 1) - 1))

    def index(self, t_us: int) -> int:
        """Return the index of the period of ``t_us``."""
        numerator, denominator = self._period
        index = (t_us - self._origin_us) * denominator // numerator
        while self.rise_us(index) > t_us:
            index -= 1
        while self.rise_us(index + 1) <= t_us:
            index += 1
        return index

    def high(self, t_us: int) -> bool:
        """Return whether the gate's signal is high at ``t_us``: from rising to falling edge."""
        return self._flank(t_us).high

    def flank_us(self, t_us: int) -> int:
        """Return the first edge of the gate's signal after ``t_us``."""
        return self._flank(t_us).end_us

    def level(self, t_us: int) -> float:
        """Return the light at ``t_us``, 0 to 1."""
        begin_us, end_us, rising = self._flank(t_us)
        if self.modulation.waveform != "sine":
            return float(rising)
        steps = min(SINE_STEPS, end_us - begin_us)
        step = (t_us - begin_us) * steps // (end_us - begin_us)
        share = 0.5 - 0.5 * math.cos(math.pi * (step + 0.5) / steps)
        return share if rising else 1.0 - share

    def next_us(self, t_us: int) -> int:
        """Return the first time after ``t_us`` at which the light changes."""
        begin_us, end_us, _ = self._flank(t_us)
        if self.modulation.waveform != "sine":
            return end_us
        length_us = end_us - begin_us
        steps = min(SINE_STEPS, length_us)
        step = (t_us - begin_us) * steps // length_us
        return begin_us - (-(step + 1) * length_us) // steps

    def _flank(self, t_us: int) -> _Flank:
        """Return the half-period of ``t_us``."""
        index = self.index(t_us)
        fall = self.fall_us(index)
        if t_us < fall:
            return _Flank(self.rise_us(index), fall, True)
        return _Flank(fall, self.rise_us(index + 1), False)


def _round_ratio(numerator: int, denominator: int) -> int:
    """Return the integer nearest to a ratio, halves to even, as ``round`` of a Fraction."""
    quotient, rest = divmod(numerator, denominator)
    up = 2 * rest > denominator or (2 * rest == denominator and quotient % 2 == 1)
    return quotient + up


class Timeline(Generic[Setting]):
    """Settings, each from its time on; none before the first."""

    def __init__(self) -> None:
        self._times: list[int] = []
        self._settings: list[Setting] = []

    def add(self, t_us: int, setting: Setting) -> None:
        """Use ``setting`` from ``t_us`` on; replaces settings of later times."""
        keep = bisect_left(self._times, t_us)
        self._times[keep:] = [t_us]
        self._settings[keep:] = [setting]

    def at(self, t_us: int) -> Setting | None:
        """Return the setting at ``t_us``, ``None`` before the first."""
        k = bisect_right(self._times, t_us)
        return self._settings[k - 1] if k else None

    def next_us(self, t_us: int) -> int | None:
        """Return the time of the first change after ``t_us``, ``None`` for none."""
        k = bisect_right(self._times, t_us)
        return self._times[k] if k < len(self._times) else None

    def drop_before(self, t_us: int) -> None:
        """Drop settings that no time from ``t_us`` on needs."""
        k = max(bisect_right(self._times, t_us) - 1, 0)
        del self._times[:k], self._settings[:k]


class LaserTimeline:
    """The laser's light over time; off before the first setting."""

    def __init__(self) -> None:
        self._gates: Timeline[Gate | None] = Timeline()
        self.drop_before = self._gates.drop_before

    def set(
        self, t_us: int, on: bool, modulation: Modulation | None, clock_rate: Fraction = Fraction(1)
    ) -> None:
        """Switch from ``t_us`` on; replaces settings of later times.

        Raises ``ArgumentError`` when ``on`` comes without a modulation, or without its edge.
        """
        if on and modulation is None:
            raise ArgumentError("the laser is on without a modulation; give one")
        self._gates.add(t_us, Gate(modulation, clock_rate) if on and modulation else None)

    def level(self, t_us: int) -> float:
        """Return the light of the laser at ``t_us``, 0 to 1."""
        gate = self._gates.at(t_us)
        return 0.0 if gate is None else gate.level(t_us)

    def rises(self, t_us: int) -> bool:
        """Return whether ``t_us`` is a rising edge."""
        gate = self._gates.at(t_us)
        return gate is not None and gate.rise_us(gate.index(t_us)) == t_us

    def ends_period(self, t_us: int) -> bool:
        """Return whether the lit part of a period, or the period, is complete at ``t_us``."""
        gate = self._gates.at(t_us - 1)
        if gate is None:
            return False
        index = gate.index(t_us - 1)
        return t_us in (gate.fall_us(index), gate.rise_us(index + 1))

    def edges(self, begin_us: int, end_us: int) -> list[tuple[int, bool]]:
        """Return the edges of the gate's signal from ``begin_us`` to before ``end_us``.

        Each is its time and true for a rising one.
        """
        found: list[tuple[int, bool]] = []
        t_us, high = begin_us - 1, self._high(begin_us - 1)
        while True:
            gate = self._gates.at(t_us)
            ends = [self._gates.next_us(t_us), gate.flank_us(t_us) if gate else None]
            t_us = min((end for end in ends if end is not None), default=end_us)
            if t_us >= end_us:
                return found
            if self._high(t_us) != high:
                high = not high
                found.append((t_us, high))

    def next_us(self, t_us: int) -> int | None:
        """Return the first time after ``t_us`` at which the light may change, or ``None``."""
        gate = self._gates.at(t_us)
        ends = [self._gates.next_us(t_us), gate.next_us(t_us) if gate else None]
        return min((end for end in ends if end is not None), default=None)

    def _high(self, t_us: int) -> bool:
        gate = self._gates.at(t_us)
        return gate is not None and gate.high(t_us)


class StageTimeline:
    """The stage's position over time; 0 before the first plan."""

    def __init__(self) -> None:
        self._plans: Timeline[tuple[MotionPlan, int, Fraction]] = Timeline()
        self.drop_before = self._plans.drop_before

    def set(
        self, t_us: int, plan: MotionPlan, zero_ns: int, clock_rate: Fraction = Fraction(1)
    ) -> None:
        """Follow ``plan`` from ``t_us`` on.

        The plan's clock read ``zero_ns`` at sensor time 0; ``clock_rate`` is the sensor time that
        passes per unit of the plan's.
        """
        self._plans.add(t_us, (plan, zero_ns, clock_rate))

    def state(self, t_us: int) -> tuple[float, float]:
        """Return position (mm) and velocity (mm/s) at ``t_us``."""
        found = self._plans.at(t_us)
        if found is None:
            return 0.0, 0.0
        plan, zero_ns, rate = found
        position, velocity = plan.state(zero_ns + t_us * 1000 * rate.denominator // rate.numerator)
        return float(position), float(velocity)


@dataclass(frozen=True, slots=True)
class SensorControl:
    """Settings of the sensor; the defaults are its factory's."""

    biases: Biases = field(default_factory=Biases)
    event_rate: EventRate | None = None
    """Limit of the event-rate control, ``None`` when it is off."""
