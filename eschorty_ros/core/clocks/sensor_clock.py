"""The ROS time of a sensor time."""

from __future__ import annotations

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.numbers import TIME_LIMIT, integer
from eschorty_ros.core.clocks.clock_line import T_US_LIMIT, ClockLine, Time
from eschorty_ros.core.clocks.lower_envelope import LowerEnvelope


class SensorClock:
    """Conversion between sensor microseconds and ROS nanoseconds.

    With ``zero_ns`` given (announced by the camera) the relation is fixed and exact. Without it
    offset and drift are the lower envelope of the packets' arrivals over a sliding window, see
    `LowerEnvelope`, until a better relation is known from trigger edges (:meth:`adopt`).

    The estimate may step at an observation and in `adopt`; times converted between two steps are
    strictly monotone. When arrival or sensor time goes back (clock set,
    camera restarted) the window is dropped.

    - ``zero_ns``: ROS time (ns) at which the sensor's clock read zero.
    - ``window_ns``: Length of the sliding window, ns of arrival time.

    Public attributes:
    - ``restarts``: Times the window was dropped.
    - ``residual_ns``: Lateness of the last observed packet by this clock.
    """

    def __init__(self, zero_ns: int | None = None, window_ns: int = 60_000_000_000) -> None:
        self._window_ns = integer("window_ns", window_ns, 1, TIME_LIMIT)
        self._fixed = None
        if zero_ns is not None:
            self._fixed = ClockLine(0, integer("zero_ns", zero_ns, -TIME_LIMIT, TIME_LIMIT))
        self._adopted: ClockLine | None = None
        self._envelope = LowerEnvelope(window_ns)
        self._last: tuple[int, int] | None = None
        self.restarts = 0
        self.residual_ns: int | None = None

    @property
    def exact(self) -> bool:
        """Return whether the zero was announced."""
        return self._fixed is not None

    @property
    def from_edges(self) -> bool:
        """Return whether the relation comes from trigger edges."""
        return self._adopted is not None

    @property
    def line(self) -> ClockLine | None:
        """The relation as known now, ``None`` before."""
        return self._fixed or self._adopted or self._envelope.line

    @property
    def arrival_line(self) -> ClockLine | None:
        """The relation from the packets' arrivals alone."""
        return self._fixed or self._envelope.line

    @property
    def zero_ns(self) -> int | None:
        """ROS time of sensor time 0, ns; ``None`` while the relation is unknown."""
        return None if self.line is None else self.line.to_ns(0)

    @property
    def drift_ppm(self) -> float:
        """Excess rate of ROS time over sensor time; 0 while the relation is unknown."""
        return 0.0 if self.line is None else self.line.drift_ppb * 1e-3

    @property
    def offset_age_us(self) -> int:
        """Sensor time since the newest packet that arrived without delay."""
        return 0 if self._last is None or self._fixed else self._last[0] - self._envelope.touched_us

    def goes_on(self, t_us: int, arrival_ns: int) -> bool:
        """Return whether neither time is before the last observed."""
        t_us = integer("t_us", t_us, -T_US_LIMIT, T_US_LIMIT)
        arrival_ns = integer("arrival_ns", arrival_ns, -TIME_LIMIT, TIME_LIMIT)
        return self._last is None or (t_us >= self._last[0] and arrival_ns >= self._last[1])

    def observe(self, t_us: int, arrival_ns: int) -> None:
        """Add one arrival: of the event of sensor time ``t_us`` at ROS time ``arrival_ns``."""
        t_us = integer("t_us", t_us, -T_US_LIMIT, T_US_LIMIT)
        arrival_ns = integer("arrival_ns", arrival_ns, -TIME_LIMIT, TIME_LIMIT)
        if self._fixed is None:
            if not self.goes_on(t_us, arrival_ns):
                self._envelope = LowerEnvelope(self._window_ns)
                self._adopted = None
                self.restarts += 1
            self._envelope.observe(t_us, arrival_ns)
        self._last = (t_us, arrival_ns)
        self.residual_ns = arrival_ns - self.to_ns(t_us)

    def adopt(self, line: ClockLine | None) -> None:
        """Use ``line``, known from edges, unless a zero was announced; ``None`` for arrivals."""
        self._adopted = line

    def to_ns(self, t_us: Time) -> Time:
        """Return the ROS time (ns) of sensor time ``t_us``; scalar in, ``int`` out."""
        return self._known().to_ns(t_us)

    def to_us(self, t_ns: Time) -> Time:
        """Return the sensor time (us, nearest, halves up) of ROS time ``t_ns``."""
        return self._known().to_us(t_ns)

    def _known(self) -> ClockLine:
        line = self.line
        if line is None:
            raise ArgumentError(
                "the ROS time of sensor time 0 is unknown; announce it or observe a packet first"
            )
        return line
