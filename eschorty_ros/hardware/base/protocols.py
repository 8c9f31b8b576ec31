"""The interfaces of a camera, a laser and a stage, real or emulated, towards the nodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    # For annotations only: the process that guards the laser starts without numpy.
    from eschorty_ros.core.clocks import PulseTrain
    from eschorty_ros.core.modulation import Modulation


@dataclass(frozen=True, slots=True)
class DeviceIdentity:
    """Model, serial and firmware, for logs, diagnostics and file headers."""

    model: str
    serial: str
    firmware: str = ""


@dataclass(frozen=True, slots=True)
class EventChunk:
    """Bytes that arrived together."""

    data: bytes
    """Complete 16-bit EVT3 words."""
    arrival_ns: int
    """Host time at which they were received."""
    gap: bool = False
    """Bytes were lost between the previous chunk and this one."""
    restarted: bool = False
    """The stream restarts here: earlier sensor time and decoder state are void."""


class EventSource(Protocol):
    """A camera that streams raw EVT3 bytes."""

    width: int
    height: int
    """Columns and rows of the sensor."""
    on_loss: Callable[[str], None]
    """Called with one line, from any thread, when a streaming camera is lost and searched for."""

    @property
    def identity(self) -> DeviceIdentity:
        """Return model, serial and firmware; complete after ``open``."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return one line for each oddity that ``open`` found."""

    @property
    def healthy(self) -> bool:
        """Return whether the camera streams and answers; never waits."""

    @property
    def loss(self) -> str:
        """Return why a streaming camera is searched for, one line; empty while it is there."""

    def open(self) -> None:
        """Find, probe and initialise the camera; may take seconds, ``close`` interrupts it."""

    def start(self) -> None:
        """Start streaming."""

    def stop(self) -> None:
        """End streaming; idempotent."""

    def read(self, timeout_s: float) -> EventChunk | None:
        """Return the next chunk, ``None`` when none came in ``timeout_s``.

        Raises ``DeviceError`` when the camera is lost for good.
        """

    def set_bias(self, name: str, offset: int) -> int:
        """Set one bias, an offset from the factory trim; returns the offset read back.

        Raises ``ArgumentError`` for an unknown bias or an offset outside its range,
        ``DeviceError`` when the camera is not open or reads back another value.
        """

    def set_windows(self, windows: Sequence[tuple[int, int, int, int]]) -> None:
        """Set the regions of interest: first column, first row, width, height; none is all.

        Raises ``DeviceError`` when the camera is not open or does not answer.
        """

    def filters_out(self, frequency_hz: float) -> bool:
        """Return whether a filter of the camera removes light modulated at ``frequency_hz``."""

    def read_biases(self) -> dict[str, int]:
        """Return the offsets in the camera; raises ``DeviceError`` when it is not open."""

    def statistics(self) -> dict[str, float]:
        """Return counters for diagnostics, by name with unit."""

    def close(self) -> None:
        """Release the device; idempotent."""


class LaserOutput(IntEnum):
    """Output state; ``UNKNOWN`` counts as on."""

    OFF = 0
    ON = 1
    UNKNOWN = 2


@dataclass(frozen=True, slots=True)
class LaserReadback:
    """Output and settings as the generator reports them.

    ``reason`` names the cause of an output that is off or unknown, ``""`` without one. ``warnings``
    are all oddities since opening that are no failure, ``counters`` go to diagnostics.
    """

    output: LaserOutput
    modulation: Modulation
    output_since_ns: int
    reason: str = ""
    warnings: tuple[str, ...] = field(default=(), compare=False)
    counters: Mapping[str, float] = field(default_factory=dict, compare=False)


class LaserModulator(Protocol):
    """The generator that modulates the laser. Off at construction and after every failure."""

    identity: DeviceIdentity

    def configure(self, modulation: Modulation) -> None:
        """Set waveform, frequency and duty; raises ``DeviceError`` when refused."""

    def arm(self) -> None:
        """Allow the next ``enable``."""

    def enable(self) -> None:
        """Switch the output on; raises ``DeviceError`` when not armed."""

    def disable(self) -> None:
        """Switch the output off and disarm; idempotent, never raises for being off already."""

    def readback(self) -> LaserReadback:
        """Read settings and output state back."""

    def close(self) -> None:
        """Switch off and release; idempotent."""


class RenewedLaser(LaserModulator, Protocol):
    """A generator whose light ends by itself, where it can, unless it is renewed."""

    def renew(self) -> float:
        """Extend light by one grant from now on; return the time to the next renewal, s."""


@dataclass(frozen=True, slots=True)
class StageState:
    """State of the stage at ``t_ns`` of the clock that its driver is given."""

    position_mm: float
    velocity_mm_s: float
    t_ns: int
    homed: bool
    moving: bool
    flags: tuple[str, ...]


class LinearStage(Protocol):
    """A linear stage with absolute moves that end by themselves; thread-safe."""

    identity: DeviceIdentity
    trigger: PulseTrain | None
    """Pulses of moves in either direction for the camera's trigger input; ``None`` for none."""
    travel_mm: tuple[float, float]
    speed_max_mm_s: float
    acceleration_mm_s2: float

    @property
    def healthy(self) -> bool:
        """Return whether the stage answers and nothing has failed; never waits."""

    def home(self) -> None:
        """Start homing; ``state().homed`` is true at its end."""

    def move_to(self, position_mm: float, speed_mm_s: float) -> None:
        """Start an absolute move; ``state().moving`` is true from now on until it has ended.

        Raises ``DeviceError`` outside travel, too fast or not homed.
        """

    def stop(self) -> None:
        """Begin a profiled stop; idempotent."""

    def state(self, t_ns: int | None = None) -> StageState:
        """Return the state at an earlier time, interpolated, by default at the newest time known.

        Raises ``DeviceError`` when the stage has failed.
        """

    def statistics(self) -> dict[str, float]:
        """Return counters for diagnostics, by name with unit.

        More ``command_errors`` than before are a warning.
        """

    def close(self) -> None:
        """Stop and release; idempotent."""
