"""The generator that modulates the laser: its output is off unless enabled and read back so."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import usb.core

from eschorty_ros.core.base.errors import ArgumentError, DeviceError
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.hardware.base.protocols import (
    DeviceIdentity,
    LaserOutput,
    LaserReadback,
    RenewedLaser,
)
from eschorty_ros.hardware.base.usb import find_device, open_backend
from eschorty_ros.hardware.laser.awg_channel import (
    LIGHT_SETTINGS,
    NAME,
    AwgChannel,
    requested_settings,
)
from eschorty_ros.hardware.laser.awg_profile import AwgProfile, load_profile
from eschorty_ros.hardware.laser.awg_settings import GRANT_MIN_S, AwgSettings
from eschorty_ros.hardware.laser.in_flight import CommandsInFlight, VoidedError
from eschorty_ros.hardware.laser.usbtmc import UsbTmc, is_usbtmc

FREQUENCY_DEFAULT_HZ = 70.0
"""Reported before the first ``configure``."""
OFF_LIMIT_S = 1.0
"""Time after which disabling begins no further try: the state is unknown then."""
_WARNINGS_KEPT = 32
_COUNTERS = (
    "openings",
    "faults",
    "retries",
    "switch_off_failures",
    "light_grants",
    "light_pauses",
)
_RENEWALS_PER_GRANT = 5
_PAUSE_S = 1e-3
_BUSY_S = 0.02
_RENEWAL_WAITS_S = 0.1
UNBOUNDED = (
    f"{NAME}: light does not end by itself: if guard and laser node end together it stays on "
    "until it is switched off by hand; fit an interlock in hardware"
)


class AwgLaser:
    """A waveform generator as laser modulator; off at construction and after every failure.

    Thread-safe. ``disable`` may be called at any time from any thread: the command in progress
    gives up before its next USB transfer. Light is a burst of counted cycles where the generator
    can: it ends after ``light_grant`` unless ``renew`` is called.

    - ``clock_ns``: The clock of ``LaserReadback.output_since_ns``.

    Public attributes:
    - ``identity``: As ``*IDN?`` reads.

    Raises ``DeviceError`` when no generator, or it does not confirm that its output is off.
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
        self._reason = ""
        self._warnings: list[str] = []
        self._counters = dict.fromkeys(_COUNTERS, 0)
        # Length of one grant in s, 0 where light does not end by itself; of the last one the least
        # and the latest time of its end, steady.
        self._grant_s = 0.0
        self._ends_s = (0.0, 0.0)
        # Until when a requested renewal waits for the command in progress.
        self._renew_until_s = 0.0
        self._open_channel: AwgChannel | None = None
        # The same generator is opened again after a loss, and identified once per opening.
        self._link_serial = ""
        self._identified = 0
        self.identity = DeviceIdentity(self._profile.name, settings.serial)
        with self._lock:
            self._open()
            try:
                self._disable()
                self._identify()
            except BaseException:
                self._drop()
                raise

    def configure(self, modulation: Modulation) -> None:
        """Make every setting and read it back; an output that is on is off meanwhile.

        Raises ``ArgumentError`` for a modulation the generator cannot make; nothing has changed
        then. Raises ``DeviceError`` when the generator fails, or reads back something else; its
        output is off then.
        """
        with self._command():
            bursts = self._settings.light_grant > 0.0
            requested = requested_settings(
                self._settings, self._profile, modulation, counted=bursts
            )
            lit = self._output is LaserOutput.ON
            with self._disabled_on_failure():
                self._ready = False
                self._disable(keep_armed=True)
                self._identify()
                channel = self._channel
                if not bursts or not channel.counts_cycles():
                    self._warn(UNBOUNDED)
                    requested = requested_settings(
                        self._settings, self._profile, modulation, counted=False
                    )
                cycles = float(requested.get("burst_cycles", 0.0))
                self._grant_s = cycles / modulation.frequency_hz
                channel.apply(requested)
                channel.unlock()
                self._modulation, self._ready = modulation, True
                if lit:
                    self._enable()

    def arm(self) -> None:
        """Allow the next ``enable``; raises ``DeviceError`` when closed."""
        with self._command():
            self._armed = True

    def enable(self) -> None:
        """Read all settings back, switch on, read that back.

        Raises ``DeviceError`` when not armed or configured, which changes nothing, when a setting
        differs and for a failure; after these two the output is off.
        """
        with self._command():
            if not self._armed:
                raise DeviceError(f"{NAME}: not armed; arm it before switching on")
            if not self._ready:
                raise DeviceError(f"{NAME}: not configured since it was lost; configure it again")
            with self._disabled_on_failure():
                self._armed = False
                self._enable()

    def renew(self) -> float:
        """Extend light by one grant from now on; return the time to the next renewal, s.

        Never waits for a command in progress, which extends it before its next query. A renewal
        that came too late for the burst counts as a pause, after which the light began with another
        phase: ``output_since_ns`` is its time. Does nothing for light that is off or does not end
        by itself. Raises ``DeviceError`` for a failure; the output is off then.
        """
        self._renew_until_s = time.monotonic() + _RENEWAL_WAITS_S
        if not self._lock.acquire(blocking=False):
            return _BUSY_S
        try:
            with self._turn(), self._disabled_on_failure():
                if self._renew_if_requested():
                    self._channel.unlock()
        finally:
            self._lock.release()
        left_s = self._ends_s[1] + _PAUSE_S - time.monotonic()
        if self._while_running == "ignored" and 0.0 < left_s <= self._grant_s:
            return left_s
        return (self._grant_s or GRANT_MIN_S) / _RENEWALS_PER_GRANT

    def disable(self) -> None:
        """Switch the output off and disarm; idempotent; ends within 2 s.

        Writes OUTPut OFF, lowers the levels, reads back; on a failure again after clearing the
        link, and again after opening the generator again.

        Raises ``DeviceError``, ``laser state unknown``, when the generator does not confirm;
        ``readback`` is UNKNOWN then.
        """
        with self._in_flight.disabling("switched off meanwhile"), self._lock:
            self._armed = False
            if not self._closed:
                self._disable()
                self._reason = ""

    def readback(self) -> LaserReadback:
        """Read the output back and, while it is on, levels and waveform; UNKNOWN counts as on.

        Raises ``DeviceError`` for no reply, and for an output that is on but differs from its
        settings; it is off then.
        """
        with self._command():
            if self._open_channel is not None and self._output is not LaserOutput.UNKNOWN:
                with self._disabled_on_failure():
                    self._compare_output()
            return LaserReadback(
                self._output,
                self._modulation,
                self._since_ns,
                self._reason,
                tuple(self._warnings),
                {
                    **self._counters,
                    "light_grant_s": self._grant_s,
                    "write_only": float(self._is_write_only()),
                },
            )

    def close(self) -> None:
        """Switch off and release; idempotent.

        Raises ``DeviceError``, ``laser state unknown``, after releasing it all the same.
        """
        with self._in_flight.disabling("closed"), self._lock:
            if self._closed:
                return
            self._closed = True
            try:
                self._disable()
            finally:
                self._drop()

    def _disable(self, *, keep_armed: bool = False) -> None:
        """Disable the output and confirm it, also on behalf of a command that is void.

        Raises ``DeviceError`` when three tries fail: on the open link, after clearing it, after
        opening the generator again. After ``OFF_LIMIT_S`` none is begun.
        """
        self._armed = self._armed and keep_armed
        ticket, self._ticket = self._ticket, None
        openings = self._counters["openings"]
        failures: list[DeviceError] = []
        ends_s = time.monotonic() + OFF_LIMIT_S
        try:
            for prepare in (self._open_if_lost, self._clear, self._open_again):
                if failures and time.monotonic() > ends_s:
                    break
                try:
                    prepare()
                    self._channel.disable()
                except DeviceError as error:
                    failures.append(error)
                else:
                    self._note(LaserOutput.OFF)
                    return
            self._lose(failures)
        finally:
            self._ticket = ticket
            self._ready = self._ready and openings == self._counters["openings"]

    def _open_if_lost(self) -> None:
        if self._open_channel is None:
            self._open()

    def _clear(self) -> None:
        self._channel.link.clear()

    def _open_again(self) -> None:
        if self._open_channel is not None:
            with suppress(DeviceError):
                self._open_channel.link.reset()
        self._drop()
        self._open()

    def _lose(self, failures: list[DeviceError]) -> None:
        """Note that the output may be on; raises ``DeviceError`` with the first, last failure."""
        if self._open_channel is not None:
            # A locked front panel could not be used to switch off by hand.
            with suppress(DeviceError):
                self._open_channel.link.clear()
            with suppress(DeviceError):
                self._open_channel.unlock_at_once()
        first, last = str(failures[0]), str(failures[-1])
        both = first if first == last else f"{first}; opened again: {last}"
        # The remedy first: a long message loses its middle.
        self._reason = f"treat the laser as on and switch the generator off by hand ({both})"
        self._counters["switch_off_failures"] += 1
        self._ready = False
        self._note(LaserOutput.UNKNOWN)
        raise DeviceError(f"laser state unknown: {self._reason}") from failures[0]

    @property
    def _channel(self) -> AwgChannel:
        if self._open_channel is None:
            raise DeviceError(f"{NAME}: lost; check cable and power")
        return self._open_channel

    def _open(self) -> None:
        link = _open_link(self._settings, self._profile, self._link_serial)
        self._link_serial = link.serial
        self._counters["openings"] += 1
        try:
            self._open_channel = AwgChannel(
                link,
                self._settings,
                self._profile,
                self._refuse_void,
                self._renew_if_requested,
                self._warn,
                self._counters,
            )
        except BaseException:
            # A level of the profile may lie outside its own bounds.
            link.close()
            raise

    def _drop(self) -> None:
        """Release the generator; idempotent, never raises."""
        channel, self._open_channel = self._open_channel, None
        if channel is not None:
            channel.link.close()

    def _is_write_only(self) -> bool:
        return self._open_channel is not None and not self._open_channel.reads_back

    def _warn(self, text: str) -> None:
        if text not in self._warnings and len(self._warnings) < _WARNINGS_KEPT:
            self._warnings.append(text)

    def _identify(self) -> None:
        """Read the identity once per opening."""
        if self._identified == self._counters["openings"]:
            return
        self.identity = self._channel.identify()
        self._channel.unlock()
        self._identified = self._counters["openings"]

    def _compare_output(self) -> None:
        """Refuse an output, or a waveform that is on, that reads back as something else."""
        channel = self._channel
        on = channel.output()
        if on is not None and on != (self._output is LaserOutput.ON):
            if on:
                raise DeviceError(f"{NAME}: output found on; it was not switched on from here")
            self._note(LaserOutput.OFF)
            self._ready = False
            self._reason = f"{NAME}: output found off; restarted, or switched off by hand"
        elif self._output is LaserOutput.ON:
            channel.verify(LIGHT_SETTINGS)
        channel.unlock()

    def _enable(self) -> None:
        channel = self._channel
        channel.raise_levels()
        channel.verify()
        channel.unlock()
        self._output = LaserOutput.UNKNOWN
        channel.enable()
        if self._grant_s:
            self._ends_s = (math.inf, math.inf)
            self._grant()
        self._note(LaserOutput.ON)
        self._reason = ""
        if channel.output() is False:
            raise DeviceError(f"{NAME}: output stays off; check the generator's display")
        channel.unlock()

    @property
    def _while_running(self) -> str:
        return self._profile.burst.while_running if self._profile.burst is not None else ""

    def _renew_if_requested(self) -> bool:
        """Extend light for a renewal that waits; return whether it did."""
        now_s = time.monotonic()
        lit = self._output is LaserOutput.ON and self._grant_s > 0.0 and self._ticket is not None
        early = self._while_running == "ignored" and now_s < self._ends_s[1]
        if not lit or early or now_s > self._renew_until_s:
            return False
        self._renew_until_s = 0.0
        self._grant()
        return True

    def _grant(self) -> None:
        begun_s = time.monotonic()
        self._channel.trigger()
        done_s = time.monotonic()
        self._counters["light_grants"] += 1
        paused = done_s >= self._ends_s[0]
        if paused:
            self._counters["light_pauses"] += 1
            if self._while_running != "ignored":
                self._warn(f"{NAME}: light paused, a renewal was late; light_pauses counts them")
        if paused or self._while_running == "restarts":
            self._since_ns = self._clock_ns()
        # An extended burst ends up to one cycle before a grant from the trigger on.
        cycle_s = 1.0 / self._modulation.frequency_hz
        self._ends_s = (begun_s + self._grant_s - cycle_s, done_s + self._grant_s)

    def _note(self, output: LaserOutput) -> None:
        if output is not self._output:
            self._output, self._since_ns = output, self._clock_ns()

    @contextmanager
    def _command(self) -> Iterator[None]:
        """Wait for a turn; the block gives up before its next transfer once it is void."""
        with self._lock, self._turn():
            yield

    @contextmanager
    def _turn(self) -> Iterator[None]:
        if self._closed:
            raise DeviceError(f"{NAME}: closed; open it again")
        self._ticket = self._in_flight.ticket()
        try:
            yield
        finally:
            self._ticket = None

    @contextmanager
    def _disabled_on_failure(self) -> Iterator[None]:
        try:
            yield
        except BaseException as error:
            self._armed = False
            if not isinstance(error, VoidedError):
                # A void command leaves the settings valid: they may be enabled again.
                self._ready = False
                self._reason = str(error)
            try:
                self._disable()
            except DeviceError as second:
                raise DeviceError(f"{second} (after: {error})") from error
            raise

    def _refuse_void(self) -> None:
        if self._ticket is not None:
            self._in_flight.refuse_void(self._ticket)


def _open_link(settings: AwgSettings, profile: AwgProfile, serial: str) -> UsbTmc:
    """Find the generator and claim it; ``serial`` applies where the settings name none.

    Raises ``DeviceError`` for none, several, no permission, and one that another program holds.
    """
    vendors = settings.vendors() or profile.usb.vendor_ids

    def matches(device: usb.core.Device) -> bool:
        known = device.idProduct in profile.usb.product_ids and device.idVendor in vendors
        return known and is_usbtmc(device)

    backend = open_backend(settings.backend)
    device = find_device(backend, name=NAME, matches=matches, serial=settings.serial or serial)
    return UsbTmc(device, name=NAME, timeout_s=settings.usb_timeout)


def open_laser(**settings: Any) -> RenewedLaser:
    """Open the generator from keywords, those of ``AwgSettings``.

    Raises ``ArgumentError`` for a keyword or value that is not accepted. Raises ``DeviceError`` as
    ``AwgLaser``.
    """
    try:
        return AwgLaser(AwgSettings(**settings))
    except TypeError as error:
        raise ArgumentError(f"laser settings: {error}; see AwgSettings") from error
