"""The way to the generator: opened, lost, opened anew, and dark by all means."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress

from eschorty_ros.core.errors import DeviceError
from eschorty_ros.hardware.laser.awg_channel import NAME, AwgChannel
from eschorty_ros.hardware.laser.awg_link import open_link
from eschorty_ros.hardware.laser.awg_profile import AwgProfile
from eschorty_ros.hardware.laser.awg_settings import AwgSettings

OFF_LIMIT_S = 1.0
"""Time after which switching off begins no further try: the state is unknown then."""
_WARNINGS_KEPT = 32
_BY_HAND = "treat the laser as on and switch the generator off by hand"


class AwgConnection:
    """Holds the open channel; what comes back after a loss is the generator that was lost.

    Parameters
    ----------
    settings : AwgSettings
    profile : AwgProfile
    may_go_on : callable
        Called before every transfer that may be given up; raises to give up.

    Attributes
    ----------
    openings : int
        How often the generator was opened; its settings are to be made anew after each.
    warnings : list of str
        What was odd but no failure, each once, 32 at most.
    """

    def __init__(
        self, settings: AwgSettings, profile: AwgProfile, may_go_on: Callable[[], None]
    ) -> None:
        self._settings = settings
        self._profile = profile
        self._may_go_on = may_go_on
        self._serial = ""
        self._channel: AwgChannel | None = None
        self._faults = self._retries = 0
        self.warnings: list[str] = []
        self.openings = 0

    @property
    def is_open(self) -> bool:
        """Whether there is a channel."""
        return self._channel is not None

    @property
    def channel(self) -> AwgChannel:
        """The open channel; raises ``DeviceError`` when it is lost."""
        if self._channel is None:
            raise DeviceError(f"{NAME}: lost; check cable and power")
        return self._channel

    def open(self) -> None:
        """Find the generator afresh and claim it; raises ``DeviceError``."""
        link = open_link(self._settings, self._profile, self._serial)
        self._serial = link.serial
        self.openings += 1
        self._channel = AwgChannel(link, self._settings, self._profile, self._may_go_on, self._warn)

    def drop(self) -> None:
        """Release the generator; idempotent, never raises."""
        channel, self._channel = self._channel, None
        if channel is not None:
            self._faults += channel.faults
            self._retries += channel.retries
            channel.close()

    def statistics(self) -> dict[str, float]:
        """Counters over all openings, and whether replies are done without."""
        channel = self._channel
        return {
            "openings": self.openings,
            "faults": self._faults + (channel.faults if channel else 0),
            "retries": self._retries + (channel.retries if channel else 0),
            "write_only": float(channel is not None and not channel.asks),
        }

    def darken(self) -> None:
        """Off, confirmed; else clear and again; else reset, open anew and again.

        Raises
        ------
        DeviceError
            ``laser state unknown``, after ``OFF_LIMIT_S`` and the try that is then under way.
        """
        failures: list[DeviceError] = []
        ends = time.monotonic() + OFF_LIMIT_S
        for remedy in (self._open_lost, self._clear, self._open_again):
            if failures and time.monotonic() > ends:
                break
            try:
                remedy()
                self.channel.darken()
            except DeviceError as error:
                failures.append(error)
            else:
                return
        if self._channel is not None:
            # Whoever is sent to the panel must not find it locked.
            with suppress(DeviceError):
                self._channel.clear()
            with suppress(DeviceError):
                self._channel.unlock_at_once()
        first, last = str(failures[0]), str(failures[-1])
        told = first if first == last else f"{first}; opened anew: {last}"
        raise DeviceError(f"laser state unknown: {told}; {_BY_HAND}") from failures[0]

    def _warn(self, text: str) -> None:
        if text not in self.warnings and len(self.warnings) < _WARNINGS_KEPT:
            self.warnings.append(text)

    def _open_lost(self) -> None:
        if self._channel is None:
            self.open()

    def _clear(self) -> None:
        self.channel.clear()

    def _open_again(self) -> None:
        if self._channel is not None:
            with suppress(DeviceError):
                self._channel.reset()
        self.drop()
        self.open()
