"""The laser's modulation, for the reconstruction and the laser driver."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.numbers import TIME_LIMIT, integer, number, short

WAVEFORMS = ("square", "sine", "pulse")
FREQUENCY_MIN_HZ = 16.0
FREQUENCY_MAX_HZ = 20_000.0


@dataclass(frozen=True, slots=True)
class Modulation:
    """A periodic modulation of the laser's power.

    Parameters
    ----------
    frequency_hz : float
        Modulation frequency, 16 Hz to 20 kHz.
    duty : float
        Share of the period with the laser on, strictly between 0 and 1.
    waveform : {"square", "sine", "pulse"}
        ``square`` and ``pulse`` are both full power for ``duty`` of the period; generators
        distinguish them. ``sine`` rises as half a cosine wave for ``duty`` of the period and falls
        as another for the rest; its rising edge is where the power is least.
    on_edge_us : int, optional
        Sensor time of one rising edge, int64 microseconds; ``None`` when unknown.

    Raises
    ------
    ArgumentError
        When a value is outside its range.

    Examples
    --------
    >>> modulation = Modulation(70.0, on_edge_us=1000)
    >>> [modulation.edge_us(index) for index in (0, 1, 2, 70)]
    [1000, 15286, 29571, 1001000]
    """

    frequency_hz: float
    duty: float = 0.5
    waveform: str = "square"
    on_edge_us: int | None = None

    def __post_init__(self) -> None:
        # Numbers of numpy are taken, too.
        for name in ("duty", "frequency_hz"):
            object.__setattr__(self, name, number(name, getattr(self, name)))
        if not FREQUENCY_MIN_HZ <= self.frequency_hz <= FREQUENCY_MAX_HZ:
            raise ArgumentError(
                f"frequency_hz is {self.frequency_hz!r}; "
                f"choose {FREQUENCY_MIN_HZ:g} to {FREQUENCY_MAX_HZ:g} Hz"
            )
        if not 0.0 < self.duty < 1.0:
            raise ArgumentError(f"duty is {self.duty!r}; choose a value between 0 and 1")
        if self.on_edge_us is not None:
            on_edge_us = integer("on_edge_us", self.on_edge_us, -TIME_LIMIT, TIME_LIMIT)
            object.__setattr__(self, "on_edge_us", on_edge_us)
        if self.waveform not in WAVEFORMS:
            raise ArgumentError(
                f"waveform is {short(self.waveform)}; choose one of {', '.join(WAVEFORMS)}"
            )

    @property
    def period_us(self) -> float:
        """Length of one period in microseconds."""
        return 1e6 / self.frequency_hz

    @property
    def middle_us(self) -> float:
        """Time from a rising edge to the middle of the light in microseconds."""
        return self.duty * self.period_us * (1.0 if self.waveform == "sine" else 0.5)

    def edge_us(self, index: int) -> int:
        """Return the sensor time of rising edge ``index``, rounded to the microsecond.

        Exact for any index: the period is a ratio of integers, not an accumulated float.
        """
        if self.on_edge_us is None:
            raise ArgumentError("on_edge_us is None; give the sensor time of one rising edge")
        integer("index", index, -TIME_LIMIT, TIME_LIMIT)
        return self.on_edge_us + round(index * 1_000_000 / Fraction(self.frequency_hz))
