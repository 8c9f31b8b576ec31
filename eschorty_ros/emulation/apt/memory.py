"""Settings of a stage controller, lost with its power."""

from __future__ import annotations

from eschorty_ros.emulation.apt.axis import PulseLeg, PulseSequence
from eschorty_ros.hardware.stage import apt_messages as apt

SETTINGS = frozenset(
    f"set_{kind}"
    for kind in ("velocity", "home", "ports", "pulses", "rack_trigger", "rack_trigger_state")
)
_FORWARD, _REVERSE, _BOTH = 0x0D, 0x0E, 0x0F

Values = dict[str, int]


class Memory:
    """Settings of one axis and of its trigger output, by the messages that set them.

    - ``rack``: True for a rack, whose trigger output has messages of its own.
    """

    def __init__(self, scale: apt.Scale, rack: bool) -> None:
        self._scale, self._rack = scale, rack
        self._values: dict[str, Values] = {}
        self.reset()

    def reset(self) -> None:
        """Return to the settings at power-up."""
        scale = self._scale
        self._values = {
            name: dict.fromkeys(apt.TO_CONTROLLER[f"set_{name}"].fields, 0)
            for name in ("ports", "pulses", "rack_trigger")
        } | {
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

    def set(self, kind: str, values: Values) -> None:
        """Store the fields of the message ``set_<kind>``."""
        self._values[kind] = values

    def get(self, kind: str) -> Values | None:
        """Return the fields last set; ``None`` when there are none."""
        return self._values.get(kind)

    @property
    def speed_mm_s(self) -> float:
        """Return the speed of moves."""
        return self._values["velocity"]["velocity"] / self._scale.velocity_unit

    @property
    def acceleration_mm_s2(self) -> float:
        """Return the acceleration of moves, of homing, and of profiled stops."""
        return self._values["velocity"]["acceleration"] / self._scale.acceleration_unit

    @property
    def homing_mm_s(self) -> float:
        """Return the speed of homing."""
        return self._values["home"]["velocity"] / self._scale.velocity_unit

    @property
    def position_mode(self) -> int:
        """Return the mode of the output that gives pulses at positions, 0 without one."""
        if self._rack:
            wired = self._values.get("rack_port", {}).get("mode") == 1
            armed = self._values.get("rack_trigger_state", {}).get("state") == 1
            modes = [self._values["rack_trigger"]["out_mode"]] if wired and armed else []
        else:
            modes = [self._values["ports"][name] for name in ("mode_1", "mode_2")]
        return next((mode for mode in modes if mode in (_FORWARD, _REVERSE, _BOTH)), 0)

    @property
    def sequence(self) -> PulseSequence | None:
        """Return the pulses as they are set, ``None`` without an output that gives them."""
        mode = self.position_mode
        if not mode:
            return None
        pulses = self._values["rack_trigger" if self._rack else "pulses"]
        legs = []
        for name, sense in (("forward", 1), ("reverse", -1)):
            if mode in (_BOTH, _FORWARD if sense > 0 else _REVERSE):
                start_mm, interval_mm = (
                    self._scale.mm(pulses[f"{field}_{name}"]) for field in ("start", "interval")
                )
                legs.append(PulseLeg(sense, start_mm, interval_mm, pulses[f"count_{name}"]))
        return PulseSequence(tuple(legs), pulses["cycles"], pulses["width_us"] * 1000)
