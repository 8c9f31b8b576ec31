"""Messages of the Thorlabs APT protocol that a brushless stage needs: layouts, scaling, bits.

Thorlabs' Host-Controller Communications Protocol, issue 15 and that of December 2025, for all but
the length of two messages. ``set_pulses`` of a KBD101 has the 12 reserved bytes at its end that the
manufacturer's example for the serial port has; ``set_rack_trigger`` ends after one reserved word
of four, as a published BBD302 driver sends it. Unconfirmed on hardware.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from eschorty_ros.core.base.errors import ArgumentError

HOST: Final = 0x01
RACK: Final = 0x11
SINGLE_UNIT: Final = 0x50
SOURCES: Final = frozenset({0x00, RACK, *range(0x21, 0x2B), SINGLE_UNIT})
HEADER_BYTES: Final = 6
LONG: Final = 0x80
_DEFAULTS: Final = {"channel": 1, "reserved": 0}


def bay_address(bay: int) -> int:
    """Return the address of bay ``bay`` of a rack, counted from 1."""
    if not 1 <= bay <= 10:
        raise ArgumentError(f"bay is {bay}; choose 1 to 10")
    return 0x20 + bay


@dataclass(frozen=True, slots=True)
class Layout:
    """One message: name, identifier, fields in order, and the payload's ``struct`` codes.

    Without a payload the fields are the header's two parameter bytes.
    """

    name: str
    id: int
    fields: tuple[str, ...] = ()
    payload: str = ""
    may_be_longer: bool = False
    """Reserved bytes may follow the payload: public drivers disagree on their number."""

    @property
    def payload_bytes(self) -> int:
        """Return the length of the payload, 0 for a short message."""
        return struct.calcsize("<" + self.payload)

    def fits(self, payload_bytes: int) -> bool:
        """Return whether a payload of this length is one of this message."""
        reserved_bytes = payload_bytes - self.payload_bytes
        return reserved_bytes == 0 or (self.may_be_longer and reserved_bytes > 0)


_CHANNEL = ("channel",)
_STATUS = ("channel", "position", "velocity", "current", "bits")
_VELOCITY = ("channel", "minimum", "acceleration", "velocity")
_HOME = ("channel", "direction", "limit", "velocity", "offset")
_PULSES = (
    *("start_forward", "interval_forward", "count_forward"),
    *("start_reverse", "interval_reverse", "count_reverse"),
    *("width_us", "cycles"),
)
_PORTS = ("channel", "mode_1", "polarity_1", "mode_2", "polarity_2")
_RACK_TRIGGER = (
    *("channel", "in_mode", "in_polarity", "in_source", "out_mode", "out_polarity"),
    *_PULSES,
    "reserved",
)

TO_CONTROLLER: Final = {
    layout.name: layout
    for layout in (
        Layout("disconnect", 0x0002),
        Layout("request_info", 0x0005),
        Layout("stop_updates", 0x0012),
        Layout("connect", 0x0018),
        Layout("request_bay", 0x0060, ("bay",)),
        Layout("set_enabled", 0x0210, ("channel", "state")),
        Layout("set_rack_trigger", 0x0260, _RACK_TRIGGER, "6H8iH"),
        Layout("request_rack_trigger", 0x0261, _CHANNEL),
        Layout("set_rack_port", 0x0263, ("port", "mode", "source"), "3H"),
        Layout("set_rack_trigger_state", 0x0272, ("channel", "state")),
        Layout("set_velocity", 0x0413, _VELOCITY, "H3i"),
        Layout("request_velocity", 0x0414, _CHANNEL),
        Layout("set_home", 0x0440, _HOME, "3H2i"),
        Layout("home", 0x0443, _CHANNEL),
        Layout("move_absolute", 0x0453, ("channel", "position"), "Hi"),
        Layout("stop", 0x0465, ("channel", "mode")),
        Layout("resume_end_of_move", 0x046C),
        Layout("request_status", 0x0490, _CHANNEL),
        Layout("keep_alive", 0x0492),
        Layout("set_profile_mode", 0x04E3, ("channel", "mode", "jerk"), "2HI4x"),
        Layout("request_axis", 0x04F1, _CHANNEL),
        Layout("set_ports", 0x0523, _PORTS, "5H12x"),
        Layout("request_ports", 0x0524, _CHANNEL),
        Layout("set_pulses", 0x0526, ("channel", *_PULSES), "H8i12x"),
        Layout("request_pulses", 0x0527, _CHANNEL),
    )
}

_INCOMING = (
    Layout(
        "info",
        0x0006,
        (
            *("serial", "model", "type", "minor", "interim", "major", "notes"),
            *("hardware", "modification", "channels"),
        ),
        "I8sH3Bx60s3H",
    ),
    Layout("bay", 0x0061, ("bay", "state")),
    Layout("error", 0x0080),
    Layout("error_text", 0x0081, ("message", "code", "text"), "2H64s"),
    Layout("rack_trigger", 0x0262, _RACK_TRIGGER, "6H8iH", may_be_longer=True),
    Layout("velocity", 0x0415, _VELOCITY, "H3i"),
    Layout("homed", 0x0444, _CHANNEL),
    Layout("moved", 0x0464, _CHANNEL),
    Layout("moved", 0x0464, _STATUS, "HihHI"),
    Layout("stopped", 0x0466, _CHANNEL),
    Layout("stopped", 0x0466, _STATUS, "HihHI"),
    Layout("status", 0x0491, _STATUS, "HihHI"),
    Layout(
        "axis",
        0x04F2,
        (
            *("channel", "stage", "axis", "part", "serial", "counts_per_unit"),
            *("minimum", "maximum", "acceleration", "deceleration", "velocity"),
        ),
        "3H16s2I5i24x",
    ),
    Layout("ports", 0x0525, _PORTS, "5H", may_be_longer=True),
    Layout("pulses", 0x0528, ("channel", *_PULSES), "H8i", may_be_longer=True),
)

FROM_CONTROLLER: Final[Mapping[int, tuple[Layout, ...]]] = {
    id: tuple(layout for layout in _INCOMING if layout.id == id)
    for id in sorted({layout.id for layout in _INCOMING})
}

STATUS_BITS: Final = {
    0x00000001: "forward_hard_limit",
    0x00000002: "reverse_hard_limit",
    0x00000004: "forward_soft_limit",
    0x00000008: "reverse_soft_limit",
    0x00000010: "moving_forward",
    0x00000020: "moving_reverse",
    0x00000040: "jogging_forward",
    0x00000080: "jogging_reverse",
    0x00000100: "motor_connected",
    0x00000200: "homing",
    0x00000400: "homed",
    0x00000800: "initialising",
    0x00001000: "tracking",
    0x00002000: "settled",
    0x00004000: "position_error",
    0x00008000: "command_error",
    0x00010000: "interlock",
    0x00020000: "over_temperature",
    0x00040000: "supply_voltage_fault",
    0x00080000: "commutation_error",
    0x00100000: "digital_input_1",
    0x00200000: "digital_input_2",
    0x00400000: "digital_input_3",
    0x00800000: "digital_input_4",
    0x01000000: "current_limit",
    0x02000000: "encoder_fault",
    0x04000000: "over_current",
    0x08000000: "supply_current_fault",
    0x10000000: "power_ok",
    0x20000000: "active",
    0x40000000: "error",
    0x80000000: "enabled",
}
LIMITS: Final = 0xF
MOVING: Final = 0xF0
HOMED: Final = 0x400
INITIALISING: Final = 0x800
SETTLED: Final = 0x2000
POSITION_ERROR: Final = 0x4000
COMMAND_ERROR: Final = 0x8000
ERROR: Final = 0x4000_0000
# Without over_current: a short one is normal, and a lasting one disables the axis.
FAULTS: Final = 0x4A0E_0000
ENABLED: Final = 0x8000_0000


def decode_bits(bits: int) -> tuple[str, ...]:
    """Return the names of the status bits that are set."""
    return tuple(name for mask, name in STATUS_BITS.items() if bits & mask)


def axis_faults(bits: int) -> int:
    """Return the status bits that are faults of the axis.

    A command that the controller refuses is none, nor is the bit of any error that comes with it.
    """
    faults = bits & FAULTS
    return 0 if faults == ERROR and bits & COMMAND_ERROR else faults


@dataclass(frozen=True, slots=True)
class Frame:
    """One message from the controller."""

    name: str
    source: int
    values: Mapping[str, int | bytes]

    def integer(self, field: str) -> int:
        """Return the value of an integer field."""
        value = self.values[field]
        assert isinstance(value, int)
        return value

    def text(self, field: str) -> str:
        """Return the value of a text field without its padding."""
        value = self.values[field]
        assert isinstance(value, bytes)
        return value.split(b"\0", 1)[0].decode("ascii", "replace").strip()


def pack(name: str, destination: int, **values: int) -> bytes:
    """Return the frame of the message ``name`` from the host.

    Every field must be given but ``channel``, the only one by default, and ``reserved``, 0.
    """
    layout = TO_CONTROLLER[name]
    values = {key: value for key, value in _DEFAULTS.items() if key in layout.fields} | values
    fields = [values.pop(field) for field in layout.fields]
    if values:
        raise ArgumentError(f"{name} has no field {', '.join(values)}")
    if not layout.payload:
        first, second = (*fields, 0, 0)[:2]
        return struct.pack("<HBBBB", layout.id, first, second, destination, HOST)
    payload = struct.pack("<" + layout.payload, *fields)
    return struct.pack("<HHBB", layout.id, len(payload), destination | LONG, HOST) + payload


def parse(frame: bytes) -> Frame:
    """Return the fields of one complete frame from the controller.

    Raises ``ArgumentError`` when the frame is none of ``FROM_CONTROLLER``.
    """
    layout = _layout(frame)
    if layout is None or len(frame) != HEADER_BYTES + _payload_bytes(frame):
        raise ArgumentError(f"frame is {frame.hex(' ')}; give one complete known message")
    if layout.payload:
        fields = struct.unpack_from("<" + layout.payload, frame, HEADER_BYTES)
    else:
        fields = tuple(frame[2:4])
    return Frame(layout.name, frame[5], dict(zip(layout.fields, fields, strict=False)))


def frame_bytes(header: bytes) -> int:
    """Return the length of the frame that begins with these six bytes, 0 when no frame does."""
    if header[4] & ~LONG not in (0, HOST) or header[5] not in SOURCES:
        return 0
    return 0 if _layout(header) is None else HEADER_BYTES + _payload_bytes(header)


def _payload_bytes(header: bytes) -> int:
    (length,) = struct.unpack_from("<H", header, 2)
    return int(length) if header[4] & LONG else 0


def _layout(header: bytes) -> Layout | None:
    (id,) = struct.unpack_from("<H", header)
    size = _payload_bytes(header)
    # The protocol has no payload above 255 bytes.
    if bool(size) != bool(header[4] & LONG) or size > 255:
        return None
    return next((layout for layout in FROM_CONTROLLER.get(id, ()) if layout.fits(size)), None)


@dataclass(frozen=True, slots=True)
class Scale:
    """Counts of one axis to millimetres and seconds."""

    counts_per_mm: float = 20_000.0
    """Encoder counts; 20 000 for a DDS220."""
    cycle_s: float = 102.4e-6
    """Servo cycle of the brushless controllers."""

    def position(self, mm: float) -> int:
        """Return the counts of a position."""
        return round(mm * self.counts_per_mm)

    def velocity(self, mm_s: float) -> int:
        """Return the counts of a velocity parameter."""
        return round(mm_s * self.velocity_unit)

    def acceleration(self, mm_s2: float) -> int:
        """Return the counts of an acceleration parameter."""
        return round(mm_s2 * self.acceleration_unit)

    def mm(self, counts: int) -> float:
        """Return the position of counts."""
        return counts / self.counts_per_mm

    @property
    def velocity_unit(self) -> float:
        """Return the counts of 1 mm/s in a velocity parameter."""
        return self.counts_per_mm * self.cycle_s * 65536.0

    @property
    def acceleration_unit(self) -> float:
        """Return the counts of 1 mm/s2 in an acceleration parameter."""
        return self.counts_per_mm * self.cycle_s**2 * 65536.0
