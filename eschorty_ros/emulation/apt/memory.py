"""What a stage controller was told, and loses with its power."""

from __future__ import annotations

from eschorty_ros.emulation.apt.axis import PulsePattern, pulse_pattern
from eschorty_ros.hardware.stage.apt_messages import Scale

_KINDS = ("velocity", "home", "ports", "pulses", "rack_trigger")
ASKING = frozenset(f"request_{kind}" for kind in _KINDS)
SETTING = frozenset(f"set_{kind}" for kind in (*_KINDS, "rack_trigger_state"))
_FORWARD, _REVERSE, _BOTH = 0x0D, 0x0E, 0x0F

Values = dict[str, int]


class Memory:
    """Settings of one axis and of its trigger output, by the messages that set them.

    Parameters
    ----------
    scale : Scale
    rack : bool
        Whether the trigger output is a rack's, which has messages of its own.
    """

    def __init__(self, scale: Scale, rack: bool) -> None:
        self._scale, self._rack = scale, rack
        self._kept: dict[str, Values] = {}
        self.forget()

    def forget(self) -> None:
        """Go back to what is set at power-up."""
        scale = self._scale
        self._kept = {
            "velocity": {
                "channel": 1,
                "minimum": 0,
                "acceleration": scale.acceleration(1000.0),
                "velocity": scale.velocity(100.0),
            },
            "home": {
                "channel": 1,
                "direction": 2,
                "limit": 1,
                "velocity": scale.velocity(10.0),
                "offset": 0,
            },
        }

    def keep(self, kind: str, values: Values) -> None:
        """Take what the message ``set_<kind>`` holds."""
        self._kept[kind] = values

    def kept(self, kind: str) -> Values | None:
        """Fields of the message that tells of ``kind``; ``None`` when it was never set."""
        return self._kept.get(kind)

    @property
    def speed_mm_s(self) -> float:
        """Of moves."""
        return self._kept["velocity"]["velocity"] / self._scale.velocity_unit

    @property
    def acceleration_mm_s2(self) -> float:
        """Of moves, of homing, and of profiled stops."""
        return self._kept["velocity"]["acceleration"] / self._scale.acceleration_unit

    @property
    def homing_mm_s(self) -> float:
        """Speed of homing."""
        return self._kept["home"]["velocity"] / self._scale.velocity_unit

    @property
    def pattern(self) -> PulsePattern | None:
        """Pulses as ports and trigger are set."""
        ports = self._kept.get("ports", {})
        modes = {ports.get("mode_1"), ports.get("mode_2")}
        pulses = self._kept.get("pulses")
        if self._rack:
            pulses = self._kept.get("rack_trigger")
            wired = self._kept.get("rack_port", {}).get("mode") == 1
            armed = self._kept.get("rack_trigger_state", {}).get("state") == 1
            modes = {pulses["out_mode"]} if pulses and wired and armed else set()
        if pulses is None:
            return None
        forward, reverse = bool(modes & {_FORWARD, _BOTH}), bool(modes & {_REVERSE, _BOTH})
        return pulse_pattern(pulses, forward, reverse, self._scale)
