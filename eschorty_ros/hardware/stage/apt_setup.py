"""Settings of a stage controller, written and read back at each connection.

They are volatile and other programs rewrite them, so all are written at every connection, and read
back where the controller answers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from eschorty_ros.core.base.errors import ArgumentError, DeviceError, DeviceTimeoutError
from eschorty_ros.core.clocks import PulseTrain
from eschorty_ros.hardware.base.protocols import DeviceIdentity
from eschorty_ros.hardware.stage import apt_messages as apt
from eschorty_ros.hardware.stage.apt_link import AptLink

CONTROLLERS = ("kbd101", "bbd30x")
_ANSWER_S = 0.3
_ATTEMPTS = 3
_PULSE_US = 500
# At rest the carriage trembles: no pulse may be so near to an end of the move that gives it.
_PULSE_OFF_END_MM = 0.01
_STEPS_FORWARD, _STEPS_REVERSE, _OFF = 0x0D, 0x0E, 0
_OUTPUT = 1
_ARM, _DISARM = 1, 2


@dataclass(frozen=True, slots=True)
class AptSettings:
    """Connection and limits of the stage."""

    controller: str = "kbd101"
    """``kbd101`` or ``bbd30x``."""
    bay: int = 1
    """Bay of a rack, from 1."""
    speed_max_mm_s: float = 250.0
    acceleration_mm_s2: float = 2000.0
    """Caps on what the controller reports."""
    travel_mm: tuple[float, float] = (0.0, 220.0)
    """Cap on the travel it reports."""
    homing_mm_s: float = 25.0
    poll_hz: float = 50.0
    """Rate of status requests."""
    trigger_interval_mm: float = 2.0
    """Distance of the pulses for the camera; 0 for none."""
    trigger_port: int = 1
    """Output that gives the pulses: 1 or 2 of a KBD101, 1 to 3 of a BBD30x."""

    def __post_init__(self) -> None:
        if self.controller not in CONTROLLERS:
            raise ArgumentError(
                f"controller is {self.controller!r}; choose one of {', '.join(CONTROLLERS)}"
            )
        apt.bay_address(self.bay)
        for name in ("speed_max_mm_s", "acceleration_mm_s2", "homing_mm_s", "poll_hz"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ArgumentError(f"{name} is {getattr(self, name)!r}; choose a positive number")
        ports = 2 if self.controller == "kbd101" else 3
        if not 1 <= self.trigger_port <= ports:
            raise ArgumentError(f"trigger_port is {self.trigger_port}; choose 1 to {ports}")
        # Between two pulses their line must be low for as long as it is high.
        least_mm = max(0.01, 2e-6 * _PULSE_US * self.speed_max_mm_s)
        if not (self.trigger_interval_mm == 0.0 or least_mm <= self.trigger_interval_mm < math.inf):
            raise ArgumentError(
                f"trigger_interval_mm is {self.trigger_interval_mm!r}; choose 0 or {least_mm:g} mm "
                f"at least, for pulses of {_PULSE_US} us at speed_max, {self.speed_max_mm_s:g} mm/s"
            )

    @property
    def address(self) -> int:
        """Return the address of motion commands."""
        return apt.SINGLE_UNIT if self.controller == "kbd101" else apt.bay_address(self.bay)


@dataclass(frozen=True, slots=True)
class AxisData:
    """Data of the controller and its stage, within the settings' caps."""

    identity: DeviceIdentity
    scale: apt.Scale
    travel_mm: tuple[float, float]
    speed_max_mm_s: float
    acceleration_mm_s2: float


class AptSetup:
    """Requests and settings over a link."""

    def __init__(self, link: AptLink, settings: AptSettings) -> None:
        self._link = link
        self._settings = settings

    def request(
        self, name: str, answer: str, address: int | None = None, **values: int
    ) -> apt.Frame:
        """Return an answer, by default the axis's; requested again when none comes."""
        to = self._settings.address if address is None else address
        frame = apt.pack(name, to, **values)
        for attempt in range(_ATTEMPTS):
            try:
                return self._link.request(frame, answer, to, _ANSWER_S)
            except DeviceTimeoutError:
                if attempt == _ATTEMPTS - 1:
                    raise
        raise AssertionError

    def send(self, name: str, **values: int) -> None:
        """Send the axis a message."""
        self._link.send(apt.pack(name, self._settings.address, **values))

    def read_axis(self) -> AxisData:
        """Return the data of controller and stage.

        Raises ``DeviceError`` when the bay is empty or the stage's data make no sense.
        """
        settings = self._settings
        rack = settings.controller == "bbd30x"
        if rack:
            bay = self.request("request_bay", "bay", apt.RACK, bay=settings.bay - 1)
            if bay.integer("state") != 1:
                raise DeviceError(f"stage: bay {settings.bay} of the rack is empty; check bay")
        info = self.request("request_info", "info", apt.RACK if rack else None)
        axis = self.request("request_axis", "axis")
        counts = axis.integer("counts_per_unit")
        if not 100 <= counts <= 1_000_000:
            raise DeviceError(
                f"stage: the controller reports {counts} counts per mm; check that a DDS stage is "
                "connected and its memory readable"
            )
        scale = apt.Scale(float(counts))
        low = max(settings.travel_mm[0], scale.mm(axis.integer("minimum")))
        high = min(settings.travel_mm[1], scale.mm(axis.integer("maximum")))
        if not low < high:
            raise DeviceError(
                f"stage: no travel is left between {low:g} and {high:g} mm; check travel"
            )
        firmware = ".".join(str(info.integer(part)) for part in ("major", "interim", "minor"))
        name = f"{info.text('model')} with {axis.text('part') or 'unknown stage'}"
        return AxisData(
            DeviceIdentity(name, str(info.integer("serial")), firmware),
            scale,
            (low, high),
            _least(settings.speed_max_mm_s, axis.integer("velocity"), scale.velocity_unit),
            _least(
                settings.acceleration_mm_s2, axis.integer("acceleration"), scale.acceleration_unit
            ),
        )

    def write(self, axis: AxisData) -> None:
        """Write all settings but the trigger."""
        scale = axis.scale
        self.send("set_profile_mode", mode=0, jerk=0)
        self.write_velocity(axis, axis.speed_max_mm_s)
        # Reverse, to the reverse limit switch, as the manufacturer's own software sets it.
        homing = scale.velocity(min(self._settings.homing_mm_s, axis.speed_max_mm_s))
        self.send("set_home", direction=2, limit=1, velocity=homing, offset=0)
        self.send("resume_end_of_move")

    def write_velocity(self, axis: AxisData, speed_mm_s: float) -> tuple[float, float]:
        """Set speed and acceleration; return them as the controller has them (mm/s, mm/s2).

        Raises ``DeviceError`` when the controller reads back other values.
        """
        requested = {
            "acceleration": axis.scale.acceleration(axis.acceleration_mm_s2),
            "velocity": axis.scale.velocity(speed_mm_s),
        }
        self.send("set_velocity", minimum=0, **requested)
        answer = self.request("request_velocity", "velocity")
        for name, value in requested.items():
            if answer.integer(name) != value:
                raise DeviceError(
                    f"stage: the controller keeps {name} {answer.integer(name)} instead of "
                    f"{value}; lower speed or acceleration, and close other programs that use it"
                )
        return (
            requested["velocity"] / axis.scale.velocity_unit,
            requested["acceleration"] / axis.scale.acceleration_unit,
        )

    def write_trigger(self, axis: AxisData) -> PulseTrain | None:
        """Switch the pulses for the camera off; return those that moves give, ``None`` for none.

        Raises ``DeviceError`` when the interval does not fit or the controller does not take them.
        """
        scale, (low, high) = axis.scale, axis.travel_mm
        interval = scale.position(self._settings.trigger_interval_mm)
        ports = self._switch_trigger(_OFF)
        if interval == 0:
            return None
        self._check_trigger("ports", ports)
        first = scale.position(low) + interval
        count = (scale.position(high) - 1 - first) // interval + 1
        if count < 1:
            raise DeviceError(
                f"stage: trigger interval {scale.mm(interval):g} mm does not fit into the travel; "
                "choose a shorter one"
            )
        self._write_pulses(first, interval, count, _STEPS_FORWARD)
        return PulseTrain(scale.mm(first), scale.mm(interval), count)

    def arm_trigger(
        self, axis: AxisData, train: PulseTrain, start_mm: float, target_mm: float
    ) -> None:
        """Let the next move, from ``start_mm`` to ``target_mm``, give its pulses of ``train``.

        The controller gives a programmed sequence in its order and waits where one of its positions
        is not passed, so each move has a sequence of its own. Raises ``DeviceError`` when the
        controller does not take it.
        """
        scale = axis.scale
        self._switch_trigger(_OFF)
        low, high = sorted((scale.position(start_mm), scale.position(target_mm)))
        off_end = scale.position(_PULSE_OFF_END_MM)
        first, interval = scale.position(train.first_mm), scale.position(train.interval_mm)
        begin = max(-((first - low - off_end) // interval), 0)
        end = min((high - off_end - first) // interval + 1, train.count)
        if begin < end:
            mode = _STEPS_FORWARD if target_mm > start_mm else _STEPS_REVERSE
            self._write_pulses(first + begin * interval, interval, end - begin, mode)
            self._check_trigger("ports", self._switch_trigger(mode))

    def _write_pulses(self, first: int, interval: int, count: int, mode: int) -> None:
        pulses = {
            "start_forward": first,
            "interval_forward": interval,
            "count_forward": count,
            "start_reverse": first + (count - 1) * interval,
            "interval_reverse": interval,
            "count_reverse": count,
            "width_us": _PULSE_US,
            "cycles": 1,
        }
        kind, channel = "pulses", 1
        if self._settings.controller == "bbd30x":
            port, bay = self._settings.trigger_port, self._settings.bay
            kind, channel = "rack_trigger", bay
            wiring = apt.pack("set_rack_port", apt.SINGLE_UNIT, port=port, mode=_OUTPUT, source=bay)
            self._link.send(wiring)
            pulses |= {"in_mode": _OFF, "in_polarity": 1, "in_source": 0}
            pulses |= {"out_mode": mode, "out_polarity": 1}
        self.send(f"set_{kind}", channel=channel, **pulses)
        self._check_trigger(kind, pulses)

    def _switch_trigger(self, mode: int) -> dict[str, int]:
        """Switch the output to a mode; return what a KBD101 then reads back as ``ports``."""
        if self._settings.controller == "bbd30x":
            self.send("set_rack_trigger_state", state=_DISARM if mode == _OFF else _ARM)
            return {}
        first, second = (mode * (port == self._settings.trigger_port) for port in (1, 2))
        ports = {"mode_1": first, "polarity_1": 1, "mode_2": second, "polarity_2": 1}
        self.send("set_ports", **ports)
        return ports

    def _check_trigger(self, kind: str, requested: dict[str, int]) -> None:
        if not requested:
            return
        remedy = "set trigger_interval to 0 to go without"
        try:
            answer = self.request(f"request_{kind}", kind)
        except DeviceTimeoutError as error:
            raise DeviceTimeoutError(f"{error}, or {remedy}") from error
        for name, value in requested.items():
            if answer.integer(name) != value:
                raise DeviceError(
                    f"stage: the controller keeps trigger {name} {answer.integer(name)} instead of "
                    f"{value}; {remedy}"
                )


def _least(cap: float, counts: int, unit: float) -> float:
    """Return the cap, or the reported value if that is less; 0 and below report nothing.

    A value that rounds to the reported counts is within them.
    """
    return min(cap, (counts + 0.49) / unit) if counts > 0 else cap
