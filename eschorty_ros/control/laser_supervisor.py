"""Keeps a laser dark unless its gate lets it be on; no ROS."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator

from eschorty_ros.control.laser_interlock import LaserGate
from eschorty_ros.control.laser_readback import LaserRecord, LaserSnapshot
from eschorty_ros.control.periodic_thread import Lookout
from eschorty_ros.core.base.errors import DeviceError, EschortyError
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.hardware.base.protocols import LaserModulator, LaserOutput, LaserReadback
from eschorty_ros.hardware.base.stalls import OwnPauses
from eschorty_ros.hardware.laser.in_flight import CommandsInFlight, VoidedError

WATCH_PERIOD_S = 0.02
_PATIENCE_S = 1.0


class LaserKeeper:
    """Carries out commands on a laser and switches it off when its gate says so.

    Two threads run while it is open: one asks the gate, the other reads the generator back, and
    switches off when that is not what was asked. Commands wait for each other; switching off waits
    for none of them, and voids those that would lead to light.

    Parameters
    ----------
    gate : LaserGate
    living : callable
        Whether the process means to go on; light ends when it does not.
    changed : callable
        Called with the snapshot after every change, in order.
    alarm : callable
        Called with one line when the device failed or its output is unknown.
    log : callable
        Called with one line when the output was switched off for a reason of the keeper's own.
    readback_period_s : float

    Attributes
    ----------
    switch_offs : int
        How often light ended.
    """

    def __init__(
        self,
        gate: LaserGate,
        living: Callable[[], bool],
        changed: Callable[[LaserSnapshot], None],
        alarm: Callable[[str], None],
        log: Callable[[str], None],
        readback_period_s: float,
    ) -> None:
        self.gate = gate
        self._living, self._changed, self._alarm, self._log = living, changed, alarm, log
        self._readback_period_s = readback_period_s
        # Held briefly: by whoever tells the state and by whoever switches off.
        self._lock = threading.RLock()
        # Held as long as a command or a read-back takes; taken before ``_lock``, if both are.
        self._commands = threading.Lock()
        self._commanding = False
        self._in_flight = CommandsInFlight()
        self._laser: LaserModulator | None = None
        self._record = LaserRecord()
        self._lookouts: list[Lookout] = []
        self._pauses: OwnPauses
        self.switch_offs = 0

    @property
    def unknown(self) -> str:
        """Why the state of the output is unknown, empty when it is known."""
        return self._record.unknown

    @property
    def device(self) -> str:
        """Model of the generator, empty while none is open."""
        laser = self._laser
        return laser.identity.model if laser is not None else ""

    def open(self, laser: LaserModulator, modulation: Modulation) -> None:
        """Take over a laser: off, with this modulation; raises ``DeviceError`` when refused."""
        with self._lock:
            self._laser, self._record.asked = laser, modulation
            self._record.requested, self._record.reason = LaserOutput.OFF, "off at start"
            self.gate.switched_off()
        laser.disable()
        laser.configure(modulation)
        told = laser.readback()
        self._refuse_difference(told)
        self._hear(told)
        self._pauses = OwnPauses(WATCH_PERIOD_S)
        self._lookouts = [
            Lookout("laser watchdog", self._watch, WATCH_PERIOD_S, self._blind),
            Lookout("laser read-back", self._read, self._readback_period_s, self._blind),
        ]

    def close(self) -> None:
        """Switch off and release; idempotent. Raises ``DeviceError`` when it is not confirmed."""
        for lookout in self._lookouts:
            lookout.end(_PATIENCE_S)
        with self._in_flight.disabling("closed"), self._lock:
            laser, self._laser = self._laser, None
            if laser is None:
                return
            try:
                laser.close()
            except EschortyError as error:
                self._record.lose(error)
                self.tell()
                raise
            finally:
                if not self.unknown:
                    self._record.told = None

    def configure(self, modulation: Modulation) -> None:
        """Set another modulation; light that is on goes on with it, unless it is refused."""
        if self._laser is None:
            return
        with self._command() as (laser, _):
            before, self._record.asked = self._record.asked, modulation
            try:
                laser.configure(modulation)
                told = laser.readback()
                self._refuse_difference(told)
            except EschortyError as error:
                self._record.asked = before
                self._end_light(error)
                raise
            self._hear(told)

    def arm(self) -> None:
        """Allow ``enable`` for a while; raises ``DeviceError`` when it must not be."""
        if self.gate.interlock_open:
            raise DeviceError("laser refused: interlock open; close it")
        with self._command() as (laser, ticket):
            laser.arm()
            with self._lock:
                self._in_flight.refuse_void(ticket)
                self.gate.arm()
                self._record.reason = "armed"

    def enable(self) -> None:
        """Switch on, unless it is; raises ``DeviceError`` when it must not be, or fails."""
        with self._command() as (laser, ticket):
            with self._lock:
                self._in_flight.refuse_void(ticket)
                if self._record.requested is LaserOutput.ON:
                    return
                refusal = self.gate.refusal()
                if refusal is not None:
                    raise DeviceError(f"laser refused: {refusal}")
                self._record.requested = LaserOutput.ON
                self.gate.switched_on()
            try:
                laser.enable()
                told = laser.readback()
                self._refuse_difference(told)
            except EschortyError as error:
                self._end_light(error)
                raise
            with self._lock:
                try:
                    self._in_flight.refuse_void(ticket)
                except VoidedError:
                    laser.disable()
                    raise
                self._record.reason = "switched on by request"
                self._hear(told)

    def switch_off(self, reason: str) -> None:
        """Switch off before anything else; raises ``DeviceError`` when it is not confirmed."""
        with self._in_flight.disabling(reason), self._lock:
            laser = self._laser
            if laser is None:
                return
            try:
                laser.disable()
            except EschortyError as error:
                self._record.lose(error)
                self.tell()
                raise DeviceError(self.unknown) from error
            finally:
                self.switch_offs += self._record.requested is LaserOutput.ON
                self.gate.switched_off()
                self._record.requested, self._record.reason = LaserOutput.OFF, reason
            self._hear_off(laser)

    def darken(self, reason: str) -> bool:
        """Switch off for a reason of the keeper's own; alarm when it is not confirmed."""
        try:
            self.switch_off(reason)
        except EschortyError as error:
            self._alarm(str(error))
            return False
        self._log(f"laser off: {reason}")
        return True

    def tell(self) -> None:
        """Tell the state as it is now."""
        with self._lock:
            snapshot = self.snapshot()
            # While a command is under way nobody knows; what comes of it is told at its end.
            if snapshot is not None and not self._commanding:
                self._changed(snapshot)

    def snapshot(self) -> LaserSnapshot | None:
        """Return what is known now, ``None`` before the generator has been opened."""
        with self._lock:
            return self._record.snapshot

    @contextlib.contextmanager
    def _command(self) -> Iterator[tuple[LaserModulator, int]]:
        """Wait for a turn; gives the laser and the command's ticket."""
        ticket = self._in_flight.ticket()
        with self._commands:
            with self._lock:
                laser = self._laser
                if laser is None:
                    raise DeviceError("laser refused: not open; configure it first")
                self._commanding = True
            try:
                yield laser, ticket
            finally:
                with self._lock:
                    self._commanding = False
                    self.tell()

    def _end_light(self, error: EschortyError) -> None:
        """Switch off after a command that failed, unless somebody's switching off made it fail."""
        with self._lock:
            if self._record.requested is LaserOutput.ON:
                self.switch_off(str(error))

    def _hear(self, told: LaserReadback) -> None:
        """Note what the generator says."""
        for text in self._record.hear(told):
            self._log(text)
        self.tell()

    def _hear_off(self, laser: LaserModulator) -> None:
        """Note what the generator says after it has confirmed that it is off."""
        told: LaserReadback | None
        try:
            told = laser.readback()
        except EschortyError:
            told = self._record.off_unread()
        if told is not None:
            self._hear(told)

    def _refuse_difference(self, told: LaserReadback) -> None:
        difference = self._record.difference(told)
        if difference:
            raise DeviceError(f"laser: {difference}; look at the generator")

    def _blind(self, error: Exception) -> None:
        self.darken(f"watching it failed: {error!r}")
        self._alarm(f"laser: watching it failed: {error!r}")

    def _watch(self) -> None:
        pause_s = self._pauses.look()
        # Under the lock: somebody may be switching off already.
        with self._lock:
            if pause_s:
                self.gate.forgive(pause_s)
            reason = self.gate.must_end(self._pauses.looked_s)
            if reason is None and not self._living() and self._record.requested is LaserOutput.ON:
                reason = "the node is shutting down"
            if reason is not None:
                self.darken(reason)

    def _read(self) -> None:
        if not self._commands.acquire(blocking=False):
            return  # A command is under way; it reads back itself.
        try:
            self._read_and_compare()
        finally:
            self._commands.release()

    def _read_and_compare(self) -> None:
        ticket, laser = self._in_flight.ticket(), self._laser
        if laser is None:
            return
        try:
            told = laser.readback()
        except EschortyError as error:
            # Disabling may be what interrupted the read-back.
            if not self._in_flight.is_void(ticket) and self.darken(f"not read back: {error}"):
                self._alarm(f"laser off: {error}")
            return
        with self._lock:
            if self._in_flight.is_void(ticket):
                return
            self._hear(told)
            wrong = self._record.calls_for_darkness(told)
            if wrong:
                self.darken(wrong)
