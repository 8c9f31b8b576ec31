"""The generator that gates the laser: dark unless told otherwise and read back to be so."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from eschorty_ros.core.errors import ArgumentError, DeviceError
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.hardware.laser.awg_channel import NAME, AwgChannel, wanted_settings
from eschorty_ros.hardware.laser.awg_connection import AwgConnection
from eschorty_ros.hardware.laser.awg_profile import load_profile
from eschorty_ros.hardware.laser.awg_settings import AwgSettings
from eschorty_ros.hardware.laser.in_flight import CommandsInFlight, VoidedError
from eschorty_ros.hardware.protocols import (
    DeviceIdentity,
    LaserModulator,
    LaserOutput,
    LaserReadback,
)

FREQUENCY_DEFAULT_HZ = 70.0
"""Told before the first ``configure``."""


class AwgLaser:
    """A waveform generator as laser modulator; off at construction and after every failure.

    Thread-safe. ``disable`` may come at any time from any thread: whatever else is under way
    gives up before its next USB transfer.

    Parameters
    ----------
    settings : AwgSettings
    clock_ns : callable
        The clock of ``LaserReadback.output_since_ns``.

    Attributes
    ----------
    identity : DeviceIdentity
        As ``*IDN?`` gives it.

    Raises
    ------
    DeviceError
        No generator, or it does not confirm that it is off.
    """

    def __init__(self, settings: AwgSettings, clock_ns: Callable[[], int] = time.time_ns) -> None:
        self._settings = settings
        self._profile = load_profile(settings.profile)
        if settings.channel > self._profile.channels:
            raise ArgumentError(
                f"channel is {settings.channel}; the generator has {self._profile.channels}"
            )
        self._clock_ns = clock_ns
        self._lock = threading.Lock()
        self._in_flight = CommandsInFlight()
        # Of the command that holds the lock; none while it disables the output.
        self._ticket: int | None = None
        self._closed = False
        self._armed = False
        self._modulation = Modulation(FREQUENCY_DEFAULT_HZ)
        self._ready = False
        self._output = LaserOutput.UNKNOWN
        self._since_ns = clock_ns()
        self._connection = AwgConnection(settings, self._profile, self._may_go_on)
        self._introduced = 0
        self._failed_offs = 0
        self.identity = DeviceIdentity(self._profile.name, settings.serial)
        self._reason = ""
        with self._lock:
            self._connection.open()
            try:
                self._darken()
                self._introduce()
            except DeviceError:
                self._connection.drop()
                raise

    def configure(self, modulation: Modulation) -> None:
        """Set everything from the load to the duty, read all back; a lit output is lit again.

        Raises
        ------
        ArgumentError
            For a modulation the generator cannot do; nothing has changed then.
        DeviceError
            When the generator fails, or reads back something else; it is dark then.
        """
        with self._command():
            wanted = wanted_settings(self._settings, self._profile, modulation)
            lit = self._output is LaserOutput.ON
            with self._dark_on_failure():
                self._ready = False
                self._darken(keep_armed=True)
                self._introduce()
                channel = self._connection.channel
                channel.apply(wanted)
                channel.unlock()
                self._modulation, self._ready = modulation, True
                if lit:
                    self._light()

    def arm(self) -> None:
        """Allow the next ``enable``; raises ``DeviceError`` when closed."""
        with self._command():
            self._armed = True

    def enable(self) -> None:
        """Read all settings back, switch on, read that back.

        Raises
        ------
        DeviceError
            Not armed, not configured, a setting that is not as set, a failure: it is dark then.
        """
        with self._command():
            if not self._armed:
                raise DeviceError(f"{NAME}: not armed; arm it before switching on")
            if not self._ready:
                raise DeviceError(f"{NAME}: not configured since it was lost; configure it again")
            with self._dark_on_failure():
                self._armed = False
                self._light()

    def disable(self) -> None:
        """Switch off and disarm; idempotent, over in about 1 s, also when nothing answers.

        OUTPut OFF, then levels down, then read back; else clear and again; else reset, open anew
        and again.

        Raises
        ------
        DeviceError
            ``laser state unknown``: the generator did not confirm; ``readback`` says UNKNOWN.
        """
        with self._in_flight.disabling("switched off meanwhile"), self._lock:
            self._armed = False
            if not self._closed:
                self._darken()
                self._reason = ""

    def readback(self) -> LaserReadback:
        """Read output and, while it is lit, levels and waveform back; UNKNOWN counts as on.

        Raises
        ------
        DeviceError
            The generator does not answer, or a lit output is not as it was set: dark then.
        """
        with self._command():
            if self._connection.is_open and self._output is not LaserOutput.UNKNOWN:
                with self._dark_on_failure():
                    self._look(self._connection.channel)
            return LaserReadback(
                self._output,
                self._modulation,
                None,
                self._since_ns,
                self._reason,
                tuple(self._connection.warnings),
                {**self._connection.statistics(), "switch_off_failures": self._failed_offs},
            )

    def close(self) -> None:
        """Switch off and release; idempotent.

        Raises
        ------
        DeviceError
            ``laser state unknown``; the generator is released all the same.
        """
        try:
            self.disable()
        finally:
            with self._lock:
                self._closed = True
                self._connection.drop()

    def _introduce(self) -> None:
        """Ask who it is, once per opening; a kernel file may lead to another one than before."""
        if self._introduced == self._connection.openings:
            return
        channel = self._connection.channel
        identity = channel.introduce()
        channel.unlock()
        expected = self.identity.serial
        if self._settings.device and expected and identity.serial not in ("", expected):
            raise DeviceError(
                f"{NAME} at {self._settings.device}: its serial is {identity.serial}, {expected} "
                "was expected; give the right device or serial"
            )
        self.identity, self._introduced = identity, self._connection.openings

    def _look(self, channel: AwgChannel) -> None:
        """Compare belief and generator."""
        on = channel.output()
        if on is not None and on != (self._output is LaserOutput.ON):
            if on:
                raise DeviceError(f"{NAME}: output found on; it was not switched on from here")
            self._believe(LaserOutput.OFF)
            self._ready = False
            self._reason = f"{NAME}: output found off; restarted, or switched off by hand"
        elif self._output is LaserOutput.ON:
            channel.verify_waveform()
        channel.unlock()

    def _light(self) -> None:
        channel = self._connection.channel
        channel.raise_levels()
        channel.verify()
        channel.unlock()
        self._output = LaserOutput.UNKNOWN
        channel.set_output(True)
        self._believe(LaserOutput.ON)
        self._reason = ""
        if channel.output() is False:
            raise DeviceError(f"{NAME}: output stays off; check the generator's display")
        channel.unlock()

    def _believe(self, output: LaserOutput) -> None:
        if output is not self._output:
            self._output, self._since_ns = output, self._clock_ns()

    @contextmanager
    def _command(self) -> Iterator[None]:
        """Wait for a turn; the block gives up at its next transfer when ``disable`` is called."""
        with self._lock:
            if self._closed:
                raise DeviceError(f"{NAME}: closed; open it again")
            self._ticket = self._in_flight.ticket()
            try:
                yield
            finally:
                self._ticket = None

    @contextmanager
    def _dark_on_failure(self) -> Iterator[None]:
        try:
            yield
        except BaseException as error:
            self._armed = False
            if not isinstance(error, VoidedError):
                # Who interrupts has no quarrel with the settings: they may be lit again.
                self._ready = False
                self._reason = str(error)
            try:
                self._darken()
            except DeviceError as second:
                raise DeviceError(f"{second} (after: {error})") from error
            raise

    def _darken(self, *, keep_armed: bool = False) -> None:
        """Off by all means, also when the command that calls it is void."""
        self._armed = self._armed and keep_armed
        ticket, self._ticket = self._ticket, None
        openings = self._connection.openings
        try:
            self._connection.darken()
        except DeviceError as error:
            self._reason = str(error).removeprefix("laser state unknown: ")
            self._failed_offs += 1
            self._ready = False
            self._believe(LaserOutput.UNKNOWN)
            raise
        finally:
            self._ticket = ticket
            self._ready = self._ready and openings == self._connection.openings
        self._believe(LaserOutput.OFF)

    def _may_go_on(self) -> None:
        if self._ticket is not None:
            self._in_flight.refuse_void(self._ticket)


def open_laser(**settings: Any) -> LaserModulator:
    """Open the generator from keywords, those of ``AwgSettings``.

    Raises
    ------
    ArgumentError
        For a keyword or value that is not accepted.
    DeviceError
        As ``AwgLaser``.
    """
    try:
        return AwgLaser(AwgSettings(**settings))
    except TypeError as error:
        raise ArgumentError(f"laser settings: {error}; see AwgSettings") from error
