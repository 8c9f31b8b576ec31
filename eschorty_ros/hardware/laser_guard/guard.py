"""The laser's guard: a process that owns the generator and outlives its owner.

``GuardedLaser`` or the ``service`` starts it in a session of its own, where it ignores the
terminal's signals. It disables the output when its owner ends in any way, dumps core, is stopped,
or sends no heartbeat for too long.
"""

from __future__ import annotations

import contextlib
import os
import queue
import select
import signal
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.hardware.base.priority import GUARD_NICE, raise_priority
from eschorty_ros.hardware.base.protocols import LaserOutput, RenewedLaser
from eschorty_ros.hardware.base.stalls import StallMeter, process_fault
from eschorty_ros.hardware.laser.in_flight import CommandsInFlight, VoidedError
from eschorty_ros.hardware.laser_guard.messages import Message, Wire, failure_message
from eschorty_ros.hardware.laser_guard.opening import maker, open_again

_TURN_S = 0.02
DARK_TURN_S = 0.1
"""Longest turn of a guard or its owner while the laser is off and not armed."""
_RENEW_S = 0.05
_WATCH_LIMIT_S = 0.2
_RETRY_S = 0.25
_RETRIES_END_S = 30.0
_PRINT_TIMEOUT_S = 0.1


class Guard:
    """Serves one owner over a wire and watches it.

    A worker thread carries out what may take long. The watching thread disables the output at once,
    beside the worker: the generator's driver lets ``disable`` overtake other commands. A third one
    renews light that ends by itself, as long as the watching thread has taken a turn recently.

    - ``owner_pid``: Process to watch; 0 for one that cannot be seen from here.
    """

    def __init__(self, wire: Wire, owner_pid: int) -> None:
        self._wire = wire
        self._owner_pid = owner_pid
        self._heartbeat_timeout_s = float("inf")
        self._make: Callable[[], RenewedLaser] | None = None
        self._laser: RenewedLaser | None = None
        self._jobs: queue.SimpleQueue[tuple[int, Message]] = queue.SimpleQueue()
        self._in_flight = CommandsInFlight()
        self._dark = True
        self._lit = threading.Event()
        self._tripped = ""
        # Why the output may be on although it was disabled, and the thread that retries.
        self._unknown = ""
        self._retrying: threading.Thread | None = None
        self._received_s = time.monotonic()
        self._stalls = StallMeter()
        self._closing: Message | None = None

    def run(self) -> None:
        """Serve until the owner is gone or closes; the output is off then."""
        for name, target in (("laser commands", self._work), ("laser light", self._renew)):
            threading.Thread(target=target, name=name, daemon=True).start()
        poller = select.poll()
        poller.register(self._wire.fileno(), select.POLLIN)
        owner = self._owner_descriptor()
        if owner is not None:
            poller.register(owner, select.POLLIN)
        try:
            while self._closing is None:
                turn_s = DARK_TURN_S if self._dark and not self._lit.is_set() else _TURN_S
                ready = dict(poller.poll(turn_s * 1e3))
                stall_s = self._stalls.measure(_TURN_S)
                self._received_s = min(self._received_s + stall_s, self._stalls.measured_s)
                if owner in ready:
                    break
                messages = self._wire.receive()
                if messages is None:
                    break
                for message in messages:
                    self._handle(message)
                if messages:
                    # After handling them, which may have taken some time.
                    self._received_s = time.monotonic()
                self._watch()
        finally:
            self._finish()

    def _owner_descriptor(self) -> int | None:
        """Return a descriptor that shows the owner's end even if a child of it keeps the wire."""
        try:
            return os.pidfd_open(self._owner_pid)
        except OSError:
            return None

    def _owner_fault(self) -> str:
        return process_fault(self._owner_pid) if self._owner_pid else ""

    def _handle(self, message: Message) -> None:
        command = message["do"]
        if command == "heartbeat":
            return
        if command == "close":
            self._closing = message
        elif command == "disable":
            self._dark = True
            self._answer(message, self._disable)
        else:
            if command == "arm":
                self._dark = False
            if command == "open":
                self._heartbeat_timeout_s = message["heartbeat_timeout_s"]
            self._jobs.put((self._in_flight.ticket(), message))

    def _watch(self) -> None:
        """Trip for an owner that does not run or sends nothing; once, until armed again."""
        if self._tripped:
            return
        fault = self._owner_fault()
        if fault:
            self._trip(f"process {self._owner_pid} is {fault}")
        elif self._stalls.measured_s - self._received_s > self._heartbeat_timeout_s:
            self._trip(
                f"process {self._owner_pid} has sent no heartbeat for "
                f"{self._heartbeat_timeout_s:g} s"
            )

    def _trip(self, fault: str) -> None:
        self._tripped = f"laser guard: {fault}"
        lit = self._lit.is_set()
        try:
            self._disable()
        except Exception as error:
            _print(f"{self._tripped}; {error}")
        else:
            if lit:
                _print(f"{self._tripped}; output off")

    def _disable(self) -> None:
        with self._in_flight.disabling("switched off meanwhile; arm it again"):
            if self._laser is None:
                return
            unknown, retrying = self._unknown, self._retrying
            if unknown and retrying is not None and retrying.is_alive():
                raise DeviceError(unknown)
            try:
                if unknown and retrying is not None:
                    # The retries have closed it.
                    self._open_again()
                else:
                    self._laser.disable()
            except Exception as error:
                self._unknown = str(error)
                if self._lit.is_set():
                    self._unknown = f"{error}; trying again"
                    self._retrying = threading.Thread(target=self._retry, name="laser off")
                    self._retrying.start()
                raise
            self._lit.clear()
            self._unknown = ""

    def _retry(self) -> None:
        """Open the generator again and again until its output is off."""
        end_s = time.monotonic() + _RETRIES_END_S
        while self._unknown and time.monotonic() < end_s:
            time.sleep(_RETRY_S)
            try:
                self._open_again()
            except Exception as error:
                self._unknown = f"{error}; trying again"
            else:
                _print("laser guard: output off at last")

    def _open_again(self) -> None:
        assert self._laser is not None
        assert self._make is not None
        serial = self._laser.identity.serial
        with contextlib.suppress(Exception):
            self._laser.close()
        self._laser = open_again(self._make, serial)
        self._lit.clear()
        self._unknown = ""

    def _finish(self) -> None:
        if self._closing is not None:
            self._answer(self._closing, self._close)
        else:
            fault = self._owner_fault()
            how = f"is {fault}" if fault else "has closed its connection"
            self._trip(f"process {self._owner_pid} {how}")
        if self._retrying is not None:
            self._retrying.join()
        if self._laser is not None:
            with contextlib.suppress(Exception):
                self._laser.close()

    def _close(self) -> None:
        self._disable()
        laser, self._laser = self._laser, None
        if laser is not None:
            laser.close()

    def _answer(self, message: Message, step: Callable[[], Any]) -> None:
        try:
            answer = {"value": step()}
        except Exception as error:
            answer = failure_message(error)
        self._wire.send({"id": message["id"], **answer})

    def _work(self) -> None:
        while True:
            ticket, message = self._jobs.get()
            self._answer(message, lambda: self._carry_out(ticket, message))  # noqa: B023

    def _carry_out(self, ticket: int, message: Message) -> Any:
        command = message["do"]
        if command == "open":
            return self._open(message)
        laser = self._laser
        if laser is None:
            raise DeviceError("the laser is not open; open it first")
        if self._unknown:
            raise DeviceError(self._unknown)
        if command == "configure":
            return laser.configure(Modulation(**message["modulation"]))
        if command == "readback":
            readback = laser.readback()
            if readback.output is not LaserOutput.OFF:
                self._lit.set()
            return asdict(replace(readback, reason=readback.reason or self._tripped))
        self._in_flight.refuse_void(ticket)
        if command == "arm":
            laser.arm()
            self._tripped = ""
            return None
        return self._enable(laser, ticket)

    def _renew(self) -> None:
        pause, pause_s = threading.Event(), _RENEW_S
        while self._lit.wait() and not pause.wait(pause_s):
            pause_s, laser = _RENEW_S, self._laser
            watched = time.monotonic() - self._stalls.measured_s < _WATCH_LIMIT_S
            if laser is None or not self._lit.is_set() or self._tripped or not watched:
                continue
            try:
                pause_s = laser.renew()
            except VoidedError:
                pass
            except Exception as error:
                self._trip(f"light not renewed: {error}")

    def _open(self, message: Message) -> Message:
        self._make = maker(message["make"], message["settings"])
        self._laser = self._make()
        return asdict(self._laser.identity)

    def _enable(self, laser: RenewedLaser, ticket: int) -> None:
        if self._tripped:
            raise DeviceError(f"laser refused: {self._tripped}; arm it again")
        self._lit.set()
        laser.enable()
        try:
            self._in_flight.refuse_void(ticket)
        except VoidedError:
            laser.disable()
            raise


def _print(text: str) -> None:
    """Print to standard error; waits briefly, since its reader may be gone or stuck."""

    def write() -> None:
        with contextlib.suppress(OSError):
            os.write(2, f"{text}\n".encode())

    writer = threading.Thread(target=write, name="laser guard's messages", daemon=True)
    with contextlib.suppress(RuntimeError):
        writer.start()
        writer.join(_PRINT_TIMEOUT_S)


def _protect() -> None:
    """Keep this process from the kernel's out-of-memory killer and in time, where permitted."""
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("-1000", encoding="ascii")
    raise_priority(GUARD_NICE)
    # Where Linux shares the cores by sessions, a process's own priority counts within its session.
    with contextlib.suppress(OSError):
        Path("/proc/self/autogroup").write_text("-20", encoding="ascii")


def main() -> None:
    """Entry point of the guard process; arguments: the wire's descriptor, the owner's pid."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGPIPE):
        signal.signal(number, signal.SIG_IGN)
    _protect()
    descriptor, owner_pid = (int(argument) for argument in sys.argv[1:])
    end = socket.socket(fileno=descriptor)
    end.set_inheritable(False)
    try:
        Guard(Wire(end), owner_pid).run()
    except Exception:
        _print(f"laser guard: {traceback.format_exc()}")
        sys.exit(1)
