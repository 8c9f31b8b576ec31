"""One output of the generator: settings in the safe order, read back and compared."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TypeVar

from eschorty_ros.core.base.errors import ArgumentError, DeviceError, DeviceGoneError
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.hardware.base.protocols import DeviceIdentity
from eschorty_ros.hardware.laser.awg_profile import AwgProfile, Burst, Value
from eschorty_ros.hardware.laser.awg_settings import AwgSettings
from eschorty_ros.hardware.laser.in_flight import VoidedError
from eschorty_ros.hardware.laser.scpi import Scpi
from eschorty_ros.hardware.laser.usbtmc import UsbTmc

NAME = "laser generator"
LIGHT_SETTINGS = ("mode", "waveform", "frequency", "high", "low", "duty")
Result = TypeVar("Result")
Requested = dict[str, Value]


def requested_settings(
    settings: AwgSettings, profile: AwgProfile, modulation: Modulation, *, counted: bool
) -> Requested:
    """Return every setting of a lit output, in the order in which it is safe to make them.

    Unit and load are first, since they change what a volt means; then the clamp, before any level.
    ``counted``: as a burst of counted cycles. It starts in the middle of the dark part of a period,
    since some generators hold the level of that phase between bursts.

    Raises ``ArgumentError`` for a modulation the generator cannot make.
    """
    if modulation.waveform not in profile.waveforms:
        raise ArgumentError(
            f"waveform is {modulation.waveform!r}; the generator has {', '.join(profile.waveforms)}"
        )
    requested: Requested = {
        "amplitude_unit": "VPP",
        "load": settings.load_ohm,
        "limit_lower": 0.0,
        "limit_upper": settings.high_max_v,
        "limit_enable": True,
        "mode": profile.mode_continuous,
        "inversion": False,
        "waveform": profile.waveforms[modulation.waveform],
        "frequency": modulation.frequency_hz,
        "high": settings.high_v,
        "low": settings.low_v,
    }
    if modulation.waveform in profile.duty_waveforms:
        requested["duty"] = modulation.duty * 100.0
    elif modulation.duty != 0.5:
        raise ArgumentError(
            f"duty is {modulation.duty:g}; waveform {modulation.waveform} has none but 0.5"
        )
    if counted and profile.burst is not None:
        cycles = max(1, int(settings.light_grant * modulation.frequency_hz))
        requested |= _burst_settings(profile.burst, cycles, 180.0 * (1.0 + modulation.duty))
    for name, value in requested.items():
        profile.settings[name].check(name, value)
    return requested


def _burst_settings(burst: Burst, cycles: int, phase_deg: float) -> Requested:
    """Return the settings of a burst, in the order in which they are made."""
    return {
        "mode": burst.mode,
        "burst_type": burst.type,
        "burst_source": burst.source,
        "burst_cycles": float(cycles),
        "burst_phase": phase_deg,
    }


class AwgChannel:
    """The output that modulates the laser, over one link.

    The setting ``readback`` decides what a missing reply means: with ``required`` it is a failure,
    with ``best_effort`` nothing is read back after it, with ``off`` nothing ever is. A reply that
    contradicts a setting is always a failure.

    - ``refuse_void``: Called before every transfer but those of ``disable``; raises to give up.
    - ``before_query``: Called before every query of a setting.
    - ``warn``: Called with one line for an oddity that is no failure.
    - ``counters``: See ``Scpi``.
    """

    def __init__(
        self,
        link: UsbTmc,
        settings: AwgSettings,
        profile: AwgProfile,
        refuse_void: Callable[[], None],
        before_query: Callable[[], object],
        warn: Callable[[str], None],
        counters: dict[str, int],
    ) -> None:
        self.link = link
        self._scpi = Scpi(link, profile, refuse_void, counters)
        self._settings = settings
        self._profile = profile
        self._before_query = before_query
        self._requested: Requested = {}
        self._lowered = False
        self._no_replies = False
        self._counts: bool | None = None
        self._warn = warn
        own = settings.channel
        # This channel first.
        self._channels = (own, *(n for n in range(1, profile.channels + 1) if n != own))
        # Composed now, so that disabling only writes.
        outputs_off = [self._scpi.spelt("output", False, n) for n in self._channels]
        levels_down = [
            self._scpi.spelt("low", 0.0, own),
            self._scpi.spelt("high", profile.dark_high_v, own),
        ]
        self._disabling = [self._scpi.message(text) for text in outputs_off + levels_down]

    @property
    def reads_back(self) -> bool:
        """Return whether settings are read back."""
        return self._settings.readback != "off" and not self._no_replies

    def identify(self) -> DeviceIdentity:
        """Return maker, model, serial and firmware; empties the error queue if there is one."""
        reply = self._read_back(lambda: self._scpi.ask(self._profile.identify))
        if reply is None:
            return DeviceIdentity(self._profile.name, self.link.serial)
        if re.search(self._profile.model, reply) is None:
            self._warn(
                f"{NAME}: it is {reply[:60]!r}, but the profile is {self._profile.name}; "
                "check every setting on its display"
            )
        for error in self._scpi.drain_errors():
            self._warn(f"{NAME}: its error queue held {error[:60]!r}")
        parts = [part.strip() for part in reply.split(",")] + [""] * 4
        return DeviceIdentity(
            f"{parts[0]} {parts[1]}".strip(), parts[2] or self.link.serial, parts[3]
        )

    def apply(self, requested: Requested) -> None:
        """Make every setting of a disabled output; raises ``DeviceError`` unless all read back."""
        self._requested = dict(requested)
        for name, value in requested.items():
            if name == "high":
                self._set_levels(float(value), float(requested["low"]))
            elif name != "low":
                self._set(name, value)
        self.verify()

    def counts_cycles(self) -> bool:
        """Return whether the generator takes the settings of a burst, tried once; output off."""
        if self._counts is None:
            self._counts = self._takes_burst()
        return self._counts

    def trigger(self) -> None:
        """Start or extend a burst; raises ``DeviceError``."""
        if self._profile.burst is not None:
            self._scpi.command(self._profile.burst.trigger)

    def raise_levels(self) -> None:
        """Restore the levels that ``disable`` lowered; raises ``DeviceError``."""
        if self._lowered and "high" in self._requested:
            self._set_levels(float(self._requested["high"]), float(self._requested["low"]))

    def verify(self, names: tuple[str, ...] = ()) -> None:
        """Read settings back, by default all; raises ``DeviceError`` that names what differs."""
        wrong = []
        for name, value in self._requested.items():
            if names and name not in names:
                continue
            found = self._get(name, self._settings.channel)
            if found is not None and not self._profile.settings[name].agrees(value, found):
                wrong.append(f"{name} is {_shown(found)} instead of {_shown(value)}")
        if wrong:
            raise DeviceError(
                f"{NAME}: {', '.join(wrong)}; check its display and the profile, then configure it"
            )

    def enable(self) -> None:
        """Switch the output on; raises ``DeviceError``."""
        self._set("output", True)

    def output(self) -> bool | None:
        """Return whether the output is on, ``None`` where nothing is read back."""
        found = self._get("output", self._settings.channel)
        return None if found is None else bool(found)

    def disable(self) -> None:
        """Write OUTPut OFF for all channels and lower the levels, without a retry; read back.

        Raises ``DeviceError`` for a failure and for an output that reads back as on.
        """
        self._lowered = True
        for message in self._disabling:
            self.link.write(message)
        for channel in self._channels:
            if self._get("output", channel):
                raise DeviceError(f"{NAME}: output {channel} stays on")
        high = self._get("high", self._settings.channel)
        if high is not None and float(high) > self._profile.dark_limit_v:
            self._warn(f"{NAME}: output off, but its level stayed at {float(high):g} V")
        self.unlock()

    def unlock(self) -> None:
        """Free the front panel, where the output can be switched off by hand."""
        if self._profile.unlock is not None:
            self._scpi.command(self._profile.unlock)

    def unlock_at_once(self) -> None:
        """Free the front panel without a retry; raises ``DeviceError``."""
        if self._profile.unlock is not None:
            self.link.write(self._scpi.message(self._profile.unlock))

    def _takes_burst(self) -> bool:
        burst, own = self._profile.burst, self._settings.channel
        if burst is None or not self.reads_back:
            return False
        for name, value in _burst_settings(burst, 2, 270.0).items():
            try:
                self._set(name, value)
                # At the first difference: a query that the generator does not know has no reply.
                if not self._profile.settings[name].agrees(value, self._scpi.get(name, own)):
                    return False
            except (DeviceGoneError, VoidedError):
                raise
            except DeviceError:
                return False
        return True

    def _set(self, name: str, value: Value) -> None:
        self._scpi.set(name, value, self._settings.channel)

    def _set_levels(self, high: float, low: float) -> None:
        """Set both levels; HIGH stays above LOW: raising begins with HIGH, lowering with LOW."""
        found = self._get("high", self._settings.channel)
        present = self._profile.dark_high_v if found is None else float(found)
        levels: list[tuple[str, Value]] = [("high", high), ("low", low)]
        for name, value in levels if high >= present else reversed(levels):
            self._set(name, value)
        self._lowered = False

    def _get(self, name: str, channel: int) -> Value | None:
        self._before_query()
        return self._read_back(lambda: self._scpi.get(name, channel))

    def _read_back(self, query: Callable[[], Result]) -> Result | None:
        """Return the reply, ``None`` where the setting ``readback`` allows it to be missing."""
        if not self.reads_back:
            return None
        try:
            return query()
        except (DeviceGoneError, VoidedError):
            raise
        except DeviceError as error:
            if self._settings.readback == "required":
                raise
            self._no_replies = True
            self._warn(f"{NAME}: reading back given up, settings are not verified ({error})")
            return None


def _shown(value: Value) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
