"""What the nodes ask of a camera, a laser and a stage, real or simulated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    # Only names: the process that guards the laser starts without numpy.
    from eschorty_ros.core.modulation import Modulation
    from eschorty_ros.core.pulses import PulseTrain


@dataclass(frozen=True, slots=True)
class DeviceIdentity:
    """Who answers at the other end: goes into logs, diagnostics and file headers."""

    model: str
    serial: str
    firmware: str = ""


@dataclass(frozen=True, slots=True)
class EventChunk:
    """Bytes of one arrival.

    Parameters
    ----------
    data : bytes
        Whole 16-bit EVT3 words.
    arrival_ns : int
        Host time at which they were received.
    gap : bool
        Bytes were lost between the previous chunk and this one.
    restarted : bool
        The stream begins anew here: sensor time and decoder state of before are void.
    """

    data: bytes
    arrival_ns: int
    gap: bool = False
    restarted: bool = False


class EventSource(Protocol):
    """A camera that hands out raw EVT3 bytes."""

    width: int
    height: int

    @property
    def identity(self) -> DeviceIdentity:
        """Who it is, as far as known before ``open``."""

    def open(self) -> None:
        """Find, probe and initialise the camera; may take seconds, ``close`` interrupts it."""

    def start(self) -> None:
        """Begin streaming."""

    def stop(self) -> None:
        """End streaming; idempotent."""

    def read(self, timeout_s: float) -> EventChunk | None:
        """Take what arrived next, ``None`` when nothing came in ``timeout_s``.

        Raises ``DeviceError`` when the camera is gone for good.
        """

    def statistics(self) -> dict[str, float]:
        """Counters for diagnostics, by name with unit."""

    def close(self) -> None:
        """Release the device; idempotent."""


class LaserOutput(IntEnum):
    """Output state; ``UNKNOWN`` counts as on."""

    OFF = 0
    ON = 1
    UNKNOWN = 2


@dataclass(frozen=True, slots=True)
class LaserReadback:
    """What the generator says it does.

    ``phase_epoch_ns`` is the time of one rising edge, ``None`` where nobody knows it: a
    generator does not tell its phase. ``reason`` says why the output is off or
    unknown, when the driver knows. ``warnings`` are all oddities since opening that are no
    failure, ``counters`` go to diagnostics.
    """

    output: LaserOutput
    modulation: Modulation
    phase_epoch_ns: int | None
    output_since_ns: int
    reason: str = ""
    warnings: tuple[str, ...] = field(default=(), compare=False)
    counters: Mapping[str, float] = field(default_factory=dict, compare=False)


class LaserModulator(Protocol):
    """The generator that gates the laser. Off at construction and after every failure."""

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


@dataclass(frozen=True, slots=True)
class StageState:
    """One reading of the stage."""

    position_mm: float
    velocity_mm_s: float
    t_ns: int
    homed: bool
    moving: bool
    flags: tuple[str, ...] = field(default=())


class LinearStage(Protocol):
    """A linear stage with absolute moves that end by themselves.

    Attributes
    ----------
    trigger : PulseTrain or None
        Pulses for the camera's trigger input, in either direction; ``None`` when there are none.
    """

    identity: DeviceIdentity
    trigger: PulseTrain | None
    travel_mm: tuple[float, float]
    speed_max_mm_s: float
    acceleration_mm_s2: float

    @property
    def healthy(self) -> bool:
        """Whether the stage answers and nothing has failed; never waits."""

    def home(self) -> None:
        """Start homing; ``state().homed`` tells when it is done."""

    def move_to(self, position_mm: float, speed_mm_s: float) -> None:
        """Start an absolute move; raises ``DeviceError`` outside travel, too fast or not homed."""

    def stop(self) -> None:
        """Profiled stop; idempotent."""

    def state(self, t_ns: int | None = None) -> StageState:
        """Position, velocity, time and flags; by default at the newest time that is known.

        Raises ``DeviceError`` when the stage has failed.
        """

    def statistics(self) -> dict[str, float]:
        """Counters for diagnostics, by name with unit."""

    def close(self) -> None:
        """Stop and release; idempotent."""
