"""What the laser and the stage do, over sensor time."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field
from fractions import Fraction

from eschorty_ros.core.errors import ArgumentError
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.motion import MotionPlan


@dataclass(frozen=True)
class Gate:
    """A square wave as exact integer edges.

    Parameters
    ----------
    modulation : Modulation
        ``on_edge_us`` must be known; edges agree with :meth:`Modulation.edge_us`.

    Raises
    ------
    ArgumentError
        For an unknown edge or a waveform other than square.
    """

    modulation: Modulation
    _period: tuple[int, int] = field(init=False, repr=False, compare=False)
    _duty: tuple[int, int] = field(init=False, repr=False, compare=False)
    _origin_us: int = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.modulation.on_edge_us is None:
            raise ArgumentError("on_edge_us is None; give the sensor time of one rising edge")
        if self.modulation.waveform != "square":
            raise ArgumentError(
                f"waveform is {self.modulation.waveform!r}; the simulation renders 'square' only"
            )
        # Integers throughout: edges are asked for in the inner loop, Fraction objects are slow.
        period = 1_000_000 / Fraction(self.modulation.frequency_hz)
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

    def lit(self, t_us: int) -> bool:
        """Whether the wave is high at ``t_us``."""
        return t_us < self.fall_us(self.index(t_us))

    def next_us(self, t_us: int) -> int:
        """First edge after ``t_us``."""
        index = self.index(t_us)
        fall = self.fall_us(index)
        return fall if t_us < fall else self.rise_us(index + 1)


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

    def set(self, t_us: int, on: bool, modulation: Modulation | None) -> None:
        """Switch from ``t_us`` on; replaces what was set for later times.

        Raises
        ------
        ArgumentError
            When ``on`` without a modulation that :class:`Gate` accepts.
        """
        if on and modulation is None:
            raise ArgumentError("the laser is on without a modulation; give one")
        gate = Gate(modulation) if on and modulation is not None else None
        keep = len([t for t in self._times if t < t_us])
        self._times[keep:] = [t_us]
        self._gates[keep:] = [gate]

    def lit(self, t_us: int) -> bool:
        """Whether the laser is lit at ``t_us``."""
        gate = self._gate(t_us)
        return gate is not None and gate.lit(t_us)

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

    def _gate(self, t_us: int) -> Gate | None:
        k = bisect_right(self._times, t_us) - 1
        return self._gates[k] if k >= 0 else None


class StageTimeline:
    """Where the stage is: a list of motion plans, each from its time on; at 0 before the first."""

    def __init__(self) -> None:
        self._times: list[int] = []
        self._plans: list[tuple[MotionPlan, int]] = []

    def set(self, t_us: int, plan: MotionPlan, zero_ns: int) -> None:
        """Follow ``plan``, whose clock read ``zero_ns`` at sensor time 0, from ``t_us`` on."""
        keep = len([t for t in self._times if t < t_us])
        self._times[keep:] = [t_us]
        self._plans[keep:] = [(plan, zero_ns)]

    def state(self, t_us: int) -> tuple[float, float]:
        """Position (mm) and velocity (mm/s) at ``t_us``."""
        k = bisect_right(self._times, t_us) - 1
        if k < 0:
            return 0.0, 0.0
        plan, zero_ns = self._plans[k]
        position, velocity = plan.state(zero_ns + t_us * 1000)
        return float(position), float(velocity)

    def forget_before(self, t_us: int) -> None:
        """Drop plans that no time from ``t_us`` on needs."""
        k = max(bisect_right(self._times, t_us) - 1, 0)
        del self._times[:k], self._plans[:k]
