"""The user's settings of the generator that modulates the laser."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.numbers import integer, number

READBACK_POLICIES = ("required", "best_effort", "off")
HIGH_LIMIT_V = 10.0
"""Above the level of any laser's modulation input."""
GRANT_MIN_S, GRANT_MAX_S = 0.2, 0.5


def _field(default: Any, description: str, unit: str = "", **more: Any) -> Any:
    return field(default=default, metadata={"description": description, "unit": unit, **more})


@dataclass(frozen=True, slots=True)
class AwgSettings:
    """Generator, wiring and limits; the fields are the laser node's parameters.

    Raises ``ArgumentError`` for a HIGH above ``high_max_v``, a LOW below 0, LOW not below HIGH, and
    values out of range.
    """

    profile: str = _field("utg900e", "command set: config/awg_<name>.yaml, or a path")
    backend: str = _field("libusb", "USB library: libusb, or module:callable[?argument]")
    serial: str = _field("", "serial number of the generator; empty = the only one there is")
    vendor_ids: str = _field(
        "", "USB vendor ids in hex, with blanks between; empty = the profile's"
    )
    channel: int = _field(1, "output that modulates the laser", range=(1, 8))
    low_v: float = _field(0.0, "voltage without light", "V", range=(0.0, HIGH_LIMIT_V))
    high_v: float = _field(5.0, "voltage with light", "V", range=(0.0, HIGH_LIMIT_V))
    high_max_v: float = _field(
        5.0,
        "the most the laser's input takes; clamped in the generator",
        "V",
        range=(0.0, HIGH_LIMIT_V),
    )
    load_ohm: float = _field(
        10000.0, "resistance at the output; 10000 = high impedance", "ohm", range=(50.0, 10000.0)
    )
    readback: str = _field(
        "required",
        "reading settings back: required = no reply is a failure; best_effort = goes on without "
        "replies; off = never",
        choices=READBACK_POLICIES,
    )
    # Less than 0.5 s by what a last renewal may take on its way.
    light_grant: float = _field(
        0.45,
        "light ends by itself after so long unless it is renewed, where the generator can count "
        "cycles; 0 = never",
        "s",
        range=(0.0, GRANT_MAX_S),
    )
    # A switch-off first waits for the transfer under way, and fails after several waits of its own;
    # a renewal waits for one, too. More would exceed the 2 s of the one and the grant of the other.
    usb_timeout: float = _field(0.2, "longest wait for one USB transfer", "s", range=(0.01, 0.2))

    def __post_init__(self) -> None:
        for item in fields(self):
            self._check(item.name, item.default, item.metadata)
        if self.high_v > self.high_max_v:
            raise ArgumentError(
                f"high_v is {self.high_v:g} V, above high_max_v, {self.high_max_v:g} V; lower it, "
                "or raise high_max_v if the laser's input takes that"
            )
        if 0.0 < self.light_grant < GRANT_MIN_S:
            raise ArgumentError(
                f"light_grant is {self.light_grant:g} s; give {GRANT_MIN_S:g} to "
                f"{GRANT_MAX_S:g}, or 0 for light that does not end by itself"
            )
        if self.low_v >= self.high_v:
            raise ArgumentError(
                f"low_v is {self.low_v:g} V, not below high_v, {self.high_v:g} V; lower it"
            )
        self.vendors()

    def vendors(self) -> tuple[int, ...]:
        """Return the vendor ids, none for the profile's."""
        try:
            return tuple(int(text, 16) for text in self.vendor_ids.split())
        except ValueError:
            raise ArgumentError(
                f"vendor_ids is {self.vendor_ids!r}; write hexadecimal numbers such as 6656 664F"
            ) from None

    def _check(self, name: str, default: Any, metadata: Any) -> None:
        value = getattr(self, name)
        choices = metadata.get("choices", ())
        if choices and value not in choices:
            raise ArgumentError(f"{name} is {value!r}; choose one of {', '.join(choices)}")
        if "range" in metadata:
            (integer if isinstance(default, int) else number)(name, value, *metadata["range"])
        elif not isinstance(value, str):
            raise ArgumentError(f"{name} is {value!r}; give a text")
