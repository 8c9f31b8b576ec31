"""The laser's guard: a process that owns the generator and outlives whatever its owner dies of.

Started by ``GuardedLaser`` in a session of its own, deaf to the terminal's signals. It switches the
output off when the process that started it ends in any way, dumps core, is stopped, or is silent
for too long.
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
from dataclasses import replace
from typing import Any

from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.hardware.base.protocols import LaserModulator, LaserOutput
from eschorty_ros.hardware.base.stalls import OwnPauses
from eschorty_ros.hardware.laser.in_flight import CommandsInFlight, VoidedError
from eschorty_ros.hardware.laser.opening import maker, open_again
from eschorty_ros.hardware.laser_guard.messages import (
    Message,
    Wire,
    failure_message,
    readback_message,
    standing_still,
)

_LOOK_S = 0.02
_RETRY_S = 0.25
_INSIST_S = 30.0
_SAY_S = 0.1


class Guard:
    """Serves one owner over a wire and watches it.

    A worker thread carries out what may take long. Switching off is done by the watching thread
    at once, beside whatever the worker does: the generator's driver lets ``disable`` overtake.

    Parameters
    ----------
    wire : Wire
    owner_pid : int
        Process to watch, the parent of this one.
    """

    def __init__(self, wire: Wire, owner_pid: int) -> None:
        self._wire = wire
        self._owner_pid = owner_pid
        self._silence_s = float("inf")
        self._make: Callable[[], LaserModulator] | None = None
        self._laser: LaserModulator | None = None
        self._jobs: queue.SimpleQueue[tuple[int, Message]] = queue.SimpleQueue()
        self._in_flight = CommandsInFlight()
        self._lit = False
        self._tripped = ""
        # Why the output may be on although it was switched off, and who tries again.
        self._unknown = ""
        self._insisting: threading.Thread | None = None
        self._heard_s = time.monotonic()
        self._pauses = OwnPauses(_LOOK_S)
        self._closing: Message | None = None

    def run(self) -> None:
        """Serve until the owner is gone or closes; the output is off then."""
        threading.Thread(target=self._work, name="laser commands", daemon=True).start()
        poller = select.poll()
        poller.register(self._wire.fileno(), select.POLLIN)
        owner = self._owner_descriptor()
        if owner is not None:
            poller.register(owner, select.POLLIN)
        try:
            while self._closing is None:
                ready = dict(poller.poll(_LOOK_S * 1e3))
                pause_s = self._pauses.look()
                self._heard_s = min(self._heard_s + pause_s, self._pauses.looked_s)
                if owner in ready:
                    break
                messages = self._wire.receive()
                if messages is None:
                    break
                for message in messages:
                    self._take(message)
                if messages:
                    # Only now: what has just been done may have taken its time.
                    self._heard_s = time.monotonic()
                self._watch()
        finally:
            self._finish()

    def _owner_descriptor(self) -> int | None:
        """Descriptor that tells of the owner's end even if a child of its keeps the wire open."""
        try:
            owner = os.pidfd_open(self._owner_pid)
        except OSError:
            return None
        return owner

    def _take(self, message: Message) -> None:
        command = message["do"]
        if command == "beat":
            return
        if command == "close":
            self._closing = message
        elif command == "disable":
            self._answer(message, self._switch_off)
        else:
            if command == "open":
                self._silence_s = message["silence_s"]
            self._jobs.put((self._in_flight.ticket(), message))

    def _watch(self) -> None:
        """Switch off for an owner that stands still or is silent; once, until armed again."""
        if self._tripped:
            return
        why = standing_still(self._owner_pid)
        if not why and self._pauses.looked_s - self._heard_s > self._silence_s:
            why = f"silent for {self._silence_s:g} s"
        if why:
            self._tripped = f"laser guard: process {self._owner_pid} is {why}"
            self._try_to_switch_off(self._tripped)

    def _switch_off(self) -> None:
        with self._in_flight.disabling("switched off meanwhile; arm it again"):
            if self._laser is None:
                return
            unknown, insisting = self._unknown, self._insisting
            if unknown and insisting is not None and insisting.is_alive():
                raise DeviceError(unknown)
            try:
                if unknown and insisting is not None:
                    # Whoever insisted has closed it.
                    self._open_again()
                else:
                    self._laser.disable()
            except Exception as error:
                self._unknown = str(error)
                if self._lit:
                    self._unknown = f"{error}; trying again"
                    self._insisting = threading.Thread(target=self._insist, name="laser off")
                    self._insisting.start()
                raise
            self._lit, self._unknown = False, ""

    def _insist(self) -> None:
        """Open the generator anew until it is off; the means at hand have failed."""
        end_s = time.monotonic() + _INSIST_S
        while self._unknown and time.monotonic() < end_s:
            time.sleep(_RETRY_S)
            try:
                self._open_again()
            except Exception as error:
                self._unknown = f"{error}; trying again"
            else:
                _say("laser guard: output off at last")

    def _open_again(self) -> None:
        assert self._laser is not None
        assert self._make is not None
        serial = self._laser.identity.serial
        with contextlib.suppress(Exception):
            self._laser.close()
        self._laser = open_again(self._make, serial)
        self._lit, self._unknown = False, ""

    def _try_to_switch_off(self, reason: str) -> None:
        lit = self._lit
        try:
            self._switch_off()
        except Exception as error:
            _say(f"{reason}; {error}")
        else:
            if lit:
                _say(f"{reason}; output off")

    def _finish(self) -> None:
        if self._closing is not None:
            self._answer(self._closing, self._close)
        else:
            self._try_to_switch_off(f"laser guard: process {self._owner_pid} is gone")
        if self._insisting is not None:
            self._insisting.join()
        if self._laser is not None:
            with contextlib.suppress(Exception):
                self._laser.close()

    def _close(self) -> None:
        self._switch_off()
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
            state = laser.readback()
            self._lit |= state.output is not LaserOutput.OFF
            return readback_message(replace(state, reason=state.reason or self._tripped))
        self._in_flight.refuse_void(ticket)
        if command == "arm":
            laser.arm()
            self._tripped = ""
            return None
        return self._enable(laser, ticket)

    def _open(self, message: Message) -> Message:
        self._make = maker(message["make"], message["settings"])
        laser = self._make()
        self._laser = laser
        identity = laser.identity
        return {
            "model": identity.model,
            "serial": identity.serial,
            "firmware": identity.firmware,
        }

    def _enable(self, laser: LaserModulator, ticket: int) -> None:
        if self._tripped:
            raise DeviceError(f"laser refused: {self._tripped}; arm it again")
        self._lit = True
        laser.enable()
        try:
            self._in_flight.refuse_void(ticket)
        except VoidedError:
            laser.disable()
            raise


def _say(text: str) -> None:
    """Tell standard error; whoever reads it may be gone or stuck and is not waited for long."""

    def write() -> None:
        with contextlib.suppress(OSError):
            os.write(2, f"{text}\n".encode())

    writer = threading.Thread(target=write, name="laser guard's words", daemon=True)
    with contextlib.suppress(RuntimeError):
        writer.start()
        writer.join(_SAY_S)


def main() -> None:
    """Entry point of the guard process; arguments: the wire's descriptor, the owner's pid."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGPIPE):
        signal.signal(number, signal.SIG_IGN)
    descriptor, owner_pid = (int(argument) for argument in sys.argv[1:])
    end = socket.socket(fileno=descriptor)
    end.set_inheritable(False)
    try:
        Guard(Wire(end), owner_pid).run()
    except Exception:
        _say(f"laser guard: {traceback.format_exc()}")
        sys.exit(1)
