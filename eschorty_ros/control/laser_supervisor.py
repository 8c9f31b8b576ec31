"""Carries out commands on the laser, and disables it when its interlock or a read-back demands."""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial

from eschorty_ros.control.laser_interlock import LaserInterlock
from eschorty_ros.control.laser_readback import LaserRecord, LaserStatus
from eschorty_ros.core.base.errors import DeviceError, EschortyError
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.hardware.base.protocols import LaserModulator, LaserOutput, LaserReadback
from eschorty_ros.hardware.base.stalls import StallMeter
from eschorty_ros.hardware.laser.in_flight import CommandsInFlight, VoidedError

WATCH_PERIOD_S = 0.02
# Without light there is nothing to disable.
_DARK_PERIOD_S = 0.1
_STOP_TIMEOUT_S = 1.0


class LaserSupervisor:
    """Carries out commands on a laser and disables it when a condition for light fails.

    Two watchdogs run while it is open: one checks the interlock, the other reads the generator back
    and disables the output when that is not what was requested. Commands wait for each other;
    disabling waits for none of them, nor for a callback, and voids those that would lead to light.
    Any error of the laser's driver ends light, not only an ``EschortyError``.

    - ``running``: Whether the process continues; the output is disabled when it does not.
    - ``publish``: Called with the status after every change, in order.
    - ``alarm``: Called with one line when the device failed or its output is unknown.
    - ``log``: Called with one line when a watchdog disabled the output, and for warnings of the
      generator.

    Public attributes:
    - ``switch_offs``: How often light ended.
    """

    def __init__(
        self,
        interlock: LaserInterlock,
        running: Callable[[], bool],
        publish: Callable[[LaserStatus], None],
        alarm: Callable[[str], None],
        log: Callable[[str], None],
        readback_period_s: float,
    ) -> None:
        self.interlock = interlock
        self._running, self._publish, self._alarm, self._log = running, publish, alarm, log
        self._readback_period_s = readback_period_s
        # Held briefly, and to disable the output.
        self._lock = threading.RLock()
        self._depth = 0
        # Callbacks run without the lock, in the thread of what they are about: one that never
        # returns must neither keep light on nor a watchdog from its checks.
        self._outbox: deque[Callable[[], None]] = deque()
        self._has_news = False
        self._sending = threading.Lock()
        # Held as long as a command or a read-back takes; taken before ``_lock``, if both are.
        self._commands = threading.Lock()
        self._commanding = False
        self._in_flight = CommandsInFlight()
        self._laser: LaserModulator | None = None
        self._record = LaserRecord()
        self._trip_reason = ""
        self._watchdogs: list[_Watchdog] = []
        self._stalls: StallMeter
        self.switch_offs = 0

    @property
    def unknown(self) -> str:
        """Return why the state of the output is unknown, empty when it is known."""
        return self._record.unknown

    @property
    def device(self) -> str:
        """Return the generator's model, empty while none is open."""
        laser = self._laser
        return laser.identity.model if laser is not None else ""

    def open(self, laser: LaserModulator, modulation: Modulation) -> None:
        """Take over a laser: off, with this modulation; raises ``DeviceError`` when refused."""
        with self._locked():
            self._laser, self._record.modulation = laser, modulation
            self._record.requested, self._record.reason = LaserOutput.OFF, "off at start"
            self._trip_reason = ""
            self.interlock.note_disabled()
        laser.disable()
        laser.configure(modulation)
        self._receive(self._checked_readback(laser))
        self._stalls = StallMeter()
        self._watchdogs = [
            _Watchdog("laser watchdog", self._check_interlock, self._watch_period_s, self._fail),
            _Watchdog(
                "laser read-back",
                self._check_readback,
                lambda: self._readback_period_s,
                self._fail,
            ),
        ]

    def close(self) -> None:
        """Disable and release; idempotent. Raises ``DeviceError`` when it is not confirmed."""
        for watchdog in self._watchdogs:
            watchdog.stop()
        try:
            self._release()
        finally:
            for watchdog in self._watchdogs:
                watchdog.join()

    def _release(self) -> None:
        with self._in_flight.disabling("closed"), self._locked():
            laser, self._laser = self._laser, None
            if laser is None:
                return
            try:
                laser.close()
            except Exception as error:
                self._record.lose(error)
                self.report()
                raise
            finally:
                if not self.unknown:
                    self._record.readback = None

    def configure(self, modulation: Modulation) -> None:
        """Set another modulation; light that is on goes on with it, unless it is refused."""
        if self._laser is None:
            return
        with self._command() as laser:
            before, self._record.modulation = self._record.modulation, modulation
            try:
                laser.configure(modulation)
                readback = self._checked_readback(laser)
            except Exception as error:
                self._record.modulation = before
                self._disable_failed(error)
                raise
            self._receive(readback)

    def ticket(self) -> int:
        """Return the ticket of a command that is requested now, which disabling voids."""
        return self._in_flight.ticket()

    def arm(self, ticket: int) -> None:
        """Allow ``enable`` for a while; raises ``DeviceError`` when it must not be.

        - ``ticket``: That of the request.
        """
        fault = self.interlock.contact_fault()
        if fault:
            raise DeviceError(f"laser refused: {fault}")
        with self._command() as laser:
            laser.arm()
            with self._locked():
                self._in_flight.refuse_void(ticket)
                self.interlock.arm()
                self._record.reason, self._trip_reason = "armed", ""

    def enable(self, ticket: int) -> None:
        """Switch on, unless it is; raises ``DeviceError`` when it must not be, or fails.

        - ``ticket``: As for ``arm``.
        """
        with self._command() as laser:
            with self._locked():
                self._in_flight.refuse_void(ticket)
                if self._record.requested is LaserOutput.ON:
                    return
                refusal = self.interlock.refusal()
                if refusal is not None:
                    raise DeviceError(f"laser refused: {refusal}")
                self._record.requested = LaserOutput.ON
                self.interlock.note_enabled()
            for watchdog in self._watchdogs:
                watchdog.wake()
            try:
                laser.enable()
                readback = self._checked_readback(laser)
            except Exception as error:
                self._disable_failed(error)
                raise
            with self._locked():
                try:
                    self._in_flight.refuse_void(ticket)
                except VoidedError:
                    laser.disable()
                    raise
                self._record.reason = "switched on by request"
                self._receive(readback)

    def disable(self, reason: str) -> None:
        """Disable before anything else; raises ``DeviceError`` when it is not confirmed.

        A trip stays the reason why the output is off until the laser is armed again.
        """
        self._disable(reason, self._trip_reason or reason)

    def _disable(self, reason: str, stated: str) -> None:
        """Disable for a reason; the record has the ``stated`` one."""
        with self._in_flight.disabling(reason), self._locked():
            laser = self._laser
            if laser is None:
                return
            fault: Exception | None = None
            try:
                laser.disable()
            except Exception as error:
                fault = error
            self.switch_offs += self._record.requested is LaserOutput.ON
            self.interlock.note_disabled()
            self._record.requested, self._record.reason = LaserOutput.OFF, stated
            if fault is not None:
                self._record.lose(fault)
                self.report()
                raise DeviceError(self.unknown) from fault
            readback: LaserReadback | None
            try:
                readback = laser.readback()
            except Exception:
                readback = self._record.assume_off()
            if readback is not None:
                self._receive(readback)

    def trip(self, reason: str) -> bool:
        """Disable for a reason that nothing requested; alarms when it is not confirmed."""
        self._trip_reason = reason
        try:
            self._disable(reason, reason)
        except EschortyError as error:
            self._call(self._alarm, str(error))
            return False
        self._call(self._log, f"laser off: {reason}")
        return True

    def report(self) -> None:
        """Publish the status as it is now."""
        with self._locked():
            status = self._record.status
            # A command in progress publishes its outcome at its end.
            if status is not None and not self._commanding:
                self._later(partial(self._publish, status))

    def status(self) -> LaserStatus | None:
        """Return what is known now, ``None`` before the generator has been opened."""
        with self._locked():
            return self._record.status

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        """Hold the lock; after it, run callbacks if it has news, unless another thread does so."""
        sends = False
        try:
            with self._lock:
                self._depth += 1
                try:
                    yield
                finally:
                    self._depth -= 1
                    if self._depth == 0:
                        sends, self._has_news = self._has_news, False
        finally:
            if sends:
                self._send()

    def _later(self, callback: Callable[[], None]) -> None:
        self._outbox.append(callback)
        self._has_news = True

    def _send(self) -> None:
        # Looked at again after each turn: another thread may have added to it in between.
        while self._outbox and self._sending.acquire(blocking=False):
            try:
                while self._outbox:
                    try:
                        self._outbox.popleft()()
                    except Exception as error:
                        # It must end neither a watchdog nor a command.
                        self._log(f"laser: a report of it failed: {error!r}")
            finally:
                self._sending.release()

    def _call(self, callback: Callable[[str], None], text: str) -> None:
        with self._locked():
            self._later(partial(callback, text))

    @contextlib.contextmanager
    def _command(self) -> Iterator[LaserModulator]:
        """Wait for a turn; gives the laser."""
        with self._commands:
            with self._locked():
                laser = self._laser
                if laser is None:
                    raise DeviceError("laser refused: not open; configure it first")
                self._commanding = True
            try:
                yield laser
            finally:
                with self._locked():
                    self._commanding = False
                    self.report()

    def _checked_readback(self, laser: LaserModulator) -> LaserReadback:
        readback = laser.readback()
        difference = self._record.difference(readback)
        if difference:
            raise DeviceError(f"laser: {difference}; look at the generator")
        return readback

    def _disable_failed(self, error: Exception) -> None:
        """Disable after a command that failed, unless disabling is what made it fail."""
        with self._locked():
            if self._record.requested is LaserOutput.ON:
                self.disable(str(error))

    def _receive(self, readback: LaserReadback) -> None:
        self._store(readback)
        self.report()

    def _store(self, readback: LaserReadback) -> None:
        for text in self._record.receive(readback):
            self._call(self._log, text)

    def _watch_period_s(self) -> float:
        return WATCH_PERIOD_S if self._record.requested is LaserOutput.ON else _DARK_PERIOD_S

    def _check_interlock(self) -> None:
        stall_s = self._stalls.measure(self._watch_period_s())
        # Under the lock: the output may be being disabled already.
        with self._locked():
            if stall_s:
                self.interlock.exclude_stall(stall_s)
            reason = self.interlock.trip_reason(self._stalls.measured_s)
            if reason is None and not self._running() and self._record.requested is LaserOutput.ON:
                reason = "the node is shutting down"
            if reason is not None:
                self.trip(reason)

    def _check_readback(self) -> None:
        if not self._commands.acquire(blocking=False):
            return  # A command reads back itself.
        try:
            ticket, laser = self._in_flight.ticket(), self._laser
            if laser is not None:
                self._read_and_compare(laser, ticket)
        finally:
            self._commands.release()

    def _read_and_compare(self, laser: LaserModulator, ticket: int) -> None:
        try:
            readback = laser.readback()
        except VoidedError:
            # The guard has disabled the output; the next read-back says why.
            return
        except Exception as error:
            # Disabling may be what interrupted the read-back.
            if not self._in_flight.is_void(ticket) and self.trip(f"not read back: {error}"):
                self._call(self._alarm, f"laser off: {error}")
            return
        with self._locked():
            if self._in_flight.is_void(ticket):
                return
            news = readback != self._record.readback or readback.output is not LaserOutput.OFF
            self._store(readback)
            reason = self._record.must_disable(readback)
            # The state that is published names why the light ended.
            if reason:
                self.trip(reason)
            elif news:
                self.report()

    def _fail(self, error: Exception) -> None:
        self.trip(f"watching it failed: {error!r}")
        self._call(self._alarm, f"laser: watching it failed: {error!r}")


class _Watchdog:
    """Calls ``check`` every ``period_s()`` in a thread until ``stop``.

    It ends with the first failure, with which it calls ``fail``.
    """

    def __init__(
        self,
        name: str,
        check: Callable[[], None],
        period_s: Callable[[], float],
        fail: Callable[[Exception], None],
    ) -> None:
        self._check, self._period_s, self._fail = check, period_s, fail
        self._stopped = False
        self._woken = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Begin no further check."""
        self._stopped = True
        self.wake()

    def join(self) -> None:
        """Wait up to 1 s for a check in progress."""
        if self._thread is not threading.current_thread():
            self._thread.join(_STOP_TIMEOUT_S)

    def wake(self) -> None:
        """Begin the next period now."""
        self._woken.set()

    def _run(self) -> None:
        try:
            while not self._stopped:
                if self._woken.wait(self._period_s()):
                    self._woken.clear()
                else:
                    self._check()
        except Exception as error:
            self._fail(error)
