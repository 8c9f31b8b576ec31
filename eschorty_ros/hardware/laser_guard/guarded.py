"""A laser whose generator belongs to a guard process, so that it goes off if this process ends."""

from __future__ import annotations

import atexit
import contextlib
import itertools
import queue
import select
import threading
import time
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from eschorty_ros.core.base.errors import (
    DeviceError,
    DeviceGoneError,
    DeviceTimeoutError,
    EschortyError,
)
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.hardware.base.priority import GUARD_NICE, raise_priority
from eschorty_ros.hardware.base.protocols import DeviceIdentity, LaserReadback
from eschorty_ros.hardware.base.stalls import process_fault
from eschorty_ros.hardware.laser_guard.guard import DARK_TURN_S
from eschorty_ros.hardware.laser_guard.messages import (
    Message,
    Wire,
    failure_message,
    raise_failure,
    readback_from,
)
from eschorty_ros.hardware.laser_guard.opening import maker, open_again
from eschorty_ros.hardware.laser_guard.starting import OwnGuard, ServedGuard

HEARTBEATS_PER_TIMEOUT = 5
OPEN_TIMEOUT_S = 20.0
DISABLE_TIMEOUT_S = 2.0
EXIT_TIMEOUT_S = 2.0
_RETRIES_END_S = 1.0
_DIRECT_TIMEOUT_S = 3.0
"""For the retries and the last one's disabling, 2 s; a generator that hangs may take any time."""
_UNKNOWN = "laser state unknown: its guard is gone"
_HANGS = (
    f"{_UNKNOWN} and the generator does not answer; treat the laser as on and switch the generator "
    "off by hand"
)
_TURN_S = 0.02
_LATE_S = 0.1


class GuardedLaser:
    """Laser modulator served by a guard process (see ``guard``); thread-safe.

    ``disable`` overtakes every other call. Should the guard itself end or be stopped, this process
    opens the generator to disable it; every call but ``disable`` and ``close`` then fails.

    - ``make``: ``module:callable`` that opens the generator, in the guard.
    - ``settings``: Its keywords; JSON values.
    - ``heartbeat_timeout_s``: Without a heartbeat from this process for so long the guard disables
      the output.
    - ``answer_timeout_s``: Longest wait for an answer.
    - ``guard``: Socket of the guard's service (see ``service``); empty: a process that this one
      starts.

    Raises ``EschortyError`` as opening the generator does.
    """

    def __init__(
        self,
        make: str,
        settings: Mapping[str, Any],
        *,
        heartbeat_timeout_s: float = 1.0,
        answer_timeout_s: float = 5.0,
        guard: str = "",
    ) -> None:
        self._heartbeat_s = heartbeat_timeout_s / HEARTBEATS_PER_TIMEOUT
        self._answer_timeout_s = answer_timeout_s
        self._numbers = itertools.count()
        self._waiting: dict[int, queue.SimpleQueue[Message]] = {}
        self._opened = self._closing = self._dismissed = self._ending = False
        self._dark = True
        self._lost = ""
        self._direct = threading.Lock()
        self._direct_ends_s = 0.0
        self._off_confirmed = False
        self._guard = ServedGuard(guard) if guard else OwnGuard()
        self._wire = Wire(self._guard.end)
        self._thread = threading.Thread(target=self._watch, name="laser guard", daemon=True)
        self._thread.start()
        self._serving = threading.Thread(target=self._serve, name="laser guard wire", daemon=True)
        self._serving.start()
        try:
            identity = self._call(
                "open",
                OPEN_TIMEOUT_S,
                make=make,
                settings=dict(settings),
                heartbeat_timeout_s=heartbeat_timeout_s,
            )
        except BaseException:
            with contextlib.suppress(EschortyError):
                self.close()
            raise
        self.identity = DeviceIdentity(**identity)
        # Loaded now: after the end of the guard there is no time for it.
        self._open_directly = maker(make, settings)
        self._opened = True
        # Before the interpreter tears its modules down, which may take longer than light may last.
        atexit.register(self._close_at_exit)

    @property
    def guard_pid(self) -> int:
        """Return the process id of the guard, 0 when its service has started it."""
        return self._guard.pid

    def configure(self, modulation: Modulation) -> None:
        """Set waveform, frequency and duty; raises ``DeviceError`` when refused."""
        self._call("configure", self._answer_timeout_s, modulation=asdict(modulation))

    def arm(self) -> None:
        """Allow the next ``enable``."""
        self._dark = False
        self._call("arm", self._answer_timeout_s)

    def enable(self) -> None:
        """Switch the output on; raises ``DeviceError`` when not armed."""
        self._call("enable", self._answer_timeout_s)

    def disable(self) -> None:
        """Switch the output off and disarm; idempotent.

        Raises ``DeviceError`` when it is not confirmed that the output is off, after 5 s at most.
        """
        if not self._lost:
            try:
                self._call("disable", DISABLE_TIMEOUT_S)
            except DeviceTimeoutError:
                self._lose_guard()
            except DeviceGoneError:
                if not self._lost:
                    raise
            else:
                self._dark = True
                return
        with self._direct:
            # The watching thread does it now, or has tried.
            if not (self._thread.is_alive() or self._off_confirmed):
                self._lose_guard()
                self._thread = threading.Thread(
                    target=self._replace_guard, name="laser off", daemon=True
                )
                self._thread.start()
        # One that hangs is waited for once.
        self._thread.join(max(self._direct_ends_s - time.monotonic(), 0.0))
        if not self._off_confirmed:
            raise DeviceError(self._lost)

    def readback(self) -> LaserReadback:
        """Read settings and output state back."""
        return readback_from(self._call("readback", self._answer_timeout_s))

    def close(self) -> None:
        """Switch off and release; idempotent.

        Raises ``DeviceError`` when it is not confirmed that the output is off; the guard retries
        for a while.
        """
        if self._closing:
            return
        self._closing = True
        atexit.unregister(self._close_at_exit)
        try:
            if self._opened:
                # Before the guard ends: until then this process replaces a guard that fails.
                self.disable()
            self._dismissed = True
            if not self._lost:
                self._call("close", DISABLE_TIMEOUT_S)
        finally:
            self._dismissed = self._ending = True
            self._serving.join(EXIT_TIMEOUT_S)
            self._wire.close()
            self._guard.release()

    def _close_at_exit(self) -> None:
        # The guard prints what fails here.
        with contextlib.suppress(EschortyError):
            self.close()

    def _call(self, command: str, timeout_s: float, **arguments: Any) -> Any:
        number = next(self._numbers)
        answers: queue.SimpleQueue[Message] = queue.SimpleQueue()
        self._waiting[number] = answers
        try:
            # Checked after entering the queue: ``_replace_guard`` answers all that are entered.
            if self._lost:
                # Until it is known whether the output is off.
                self._thread.join(EXIT_TIMEOUT_S)
                raise DeviceGoneError(self._lost)
            self._wire.send({"id": number, "do": command, **arguments})
            answer = _received(answers, timeout_s)
        except queue.Empty:
            raise DeviceTimeoutError(
                f"laser guard: no answer to {command} within {timeout_s:g} s; "
                "check the generator, then configure the laser again"
            ) from None
        finally:
            del self._waiting[number]
        raise_failure(answer)
        return answer["value"]

    def _watch(self) -> None:
        """Wait for the end or the stop of the guard's process, and replace it then."""
        raise_priority(GUARD_NICE)
        self._guard.wait_until_lost()
        self._lose_guard()
        if not self._dismissed:
            self._replace_guard()

    def _serve(self) -> None:
        """Hand out answers and send heartbeats to the guard."""
        poller = select.poll()
        poller.register(self._wire.fileno(), select.POLLIN)
        heartbeat_at_s = 0.0
        while not self._ending:
            turn_s = min(DARK_TURN_S, self._heartbeat_s) if self._dark else _TURN_S
            poller.poll(turn_s * 1e3)
            messages = self._wire.receive()
            if messages is None:
                if not self._dismissed:
                    # It no longer serves, even if its process runs on.
                    self._guard.kill()
                break
            for message in messages:
                answers = self._waiting.get(message["id"])
                if answers is not None:
                    answers.put(message)
            now_s = time.monotonic()
            if now_s >= heartbeat_at_s:
                heartbeat_at_s = now_s + self._heartbeat_s
                self._wire.send({"do": "heartbeat"})
            if self._guard.pid and process_fault(self._guard.pid):
                # Also while it dumps core, before its end.
                self._guard.kill()

    def _lose_guard(self) -> None:
        self._direct_ends_s = time.monotonic() + _DIRECT_TIMEOUT_S
        self._lost = self._lost or _HANGS
        self._guard.kill()

    def _replace_guard(self) -> None:
        """Disable the output in place of the guard, then answer every call that waits for it."""
        ended = self._guard.ending(EXIT_TIMEOUT_S)
        if self._opened:
            try:
                self._disable_directly()
                self._lost = f"{ended}; output switched off; configure the laser again"
            except Exception as error:
                self._lost = str(error)
        else:
            self._lost = f"{ended} before it opened the generator; look at its message above"
        for answers in list(self._waiting.values()):
            answers.put(failure_message(DeviceGoneError(self._lost)))

    def _disable_directly(self) -> None:
        """Open the generator, which the dead guard has released, and close it: it is off then."""
        end_s = time.monotonic() + _RETRIES_END_S
        while not self._off_confirmed:
            try:
                open_again(self._open_directly, self.identity.serial).close()
                self._off_confirmed = True
            except EschortyError as error:
                if time.monotonic() > end_s:
                    raise DeviceError(f"{_UNKNOWN}; {error}") from error
                time.sleep(_TURN_S)


def _received(answers: queue.SimpleQueue[Message], timeout_s: float) -> Message:
    """Return an answer; raises ``queue.Empty`` when none comes."""
    try:
        return answers.get(timeout=timeout_s)
    except queue.Empty:
        # After a stall of this process the answers that arrived meanwhile are being handed out.
        return answers.get(timeout=_LATE_S)
