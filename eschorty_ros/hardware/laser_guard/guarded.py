"""A laser whose generator belongs to a guard process, so that it goes off whatever dies here."""

from __future__ import annotations

import contextlib
import itertools
import os
import queue
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from eschorty_ros.core.base.errors import (
    DeviceError,
    DeviceGoneError,
    DeviceTimeoutError,
    EschortyError,
)
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.hardware.base.protocols import DeviceIdentity, LaserReadback
from eschorty_ros.hardware.laser.opening import maker, open_again
from eschorty_ros.hardware.laser_guard.messages import (
    Message,
    Wire,
    failure_message,
    modulation_message,
    raise_failure,
    readback_from,
    standing_still,
)

# The guard runs the package that runs here, wherever it lies, and searches no current folder: with
# -P and the package's own folder on the path no longer than it takes to find the package.
_START_GUARD = (
    "import sys; sys.path.insert(0, sys.argv.pop(1)); import eschorty_ros; del sys.path[0]; "
    "from eschorty_ros.hardware.laser_guard.guard import main; main()"
)
_PACKAGE_FOLDER = str(Path(__file__).parents[3])
BEATS_PER_SILENCE = 5
OPEN_S = 20.0
OFF_S = 2.0
EXIT_S = 2.0
_DIRECT_S = 1.0
_LOOK_S = 0.02
_LATE_S = 0.1


class GuardedLaser:
    """Laser modulator served by a guard process (see ``guard``); thread-safe.

    ``disable`` overtakes every other call. Should the guard itself die or be stopped, this end
    opens the generator to switch it off; every call but ``disable`` and ``close`` then fails.

    Parameters
    ----------
    make : str
        ``module:callable`` that opens the generator, in the guard.
    settings : mapping
        Its keywords; JSON values.
    silence_s : float
        Without a sign of life from here for so long the guard switches off.
    answer_s : float
        Longest wait for an answer.

    Raises
    ------
    EschortyError
        Whatever opening the generator raises.
    """

    def __init__(
        self,
        make: str,
        settings: Mapping[str, Any],
        *,
        silence_s: float = 1.0,
        answer_s: float = 5.0,
    ) -> None:
        self._beat_s = silence_s / BEATS_PER_SILENCE
        self._answer_s = answer_s
        self._numbers = itertools.count()
        self._waiting: dict[int, queue.SimpleQueue[Message]] = {}
        self._opened = self._closing = self._dismissed = self._ending = False
        self._lost = ""
        self._direct = threading.Lock()
        self._off_confirmed = False
        # Both ends close on exec, the guard's is handed to the guard alone.
        here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with there:
            arguments = (_PACKAGE_FOLDER, str(there.fileno()), str(os.getpid()))
            self._guard = subprocess.Popen(
                [sys.executable, "-P", "-c", _START_GUARD, *arguments],
                stdin=subprocess.DEVNULL,
                pass_fds=(there.fileno(),),
                start_new_session=True,
            )
        self._wire = Wire(here)
        self._thread = threading.Thread(target=self._serve, name="laser guard", daemon=True)
        self._thread.start()
        try:
            identity = self._call("open", OPEN_S, make=make, settings=dict(settings),
                                  silence_s=silence_s)  # fmt: skip
        except BaseException:
            with contextlib.suppress(EschortyError):
                self.close()
            raise
        self.identity = DeviceIdentity(**identity)
        # Loaded now: should the guard die, there is no time for it.
        self._open_directly = maker(make, settings)
        self._opened = True

    @property
    def guard_pid(self) -> int:
        """Process id of the guard."""
        return self._guard.pid

    def configure(self, modulation: Modulation) -> None:
        """Set waveform, frequency and duty; raises ``DeviceError`` when refused."""
        self._call("configure", self._answer_s, modulation=modulation_message(modulation))

    def arm(self) -> None:
        """Allow the next ``enable``."""
        self._call("arm", self._answer_s)

    def enable(self) -> None:
        """Switch the output on; raises ``DeviceError`` when not armed."""
        self._call("enable", self._answer_s)

    def disable(self) -> None:
        """Switch the output off and disarm; idempotent.

        Raises
        ------
        DeviceError
            When nobody confirms that the output is off.
        """
        if not self._lost:
            try:
                self._call("disable", OFF_S)
            except DeviceTimeoutError:
                self._guard.kill()
            except DeviceGoneError:
                if not self._lost:
                    raise
            else:
                return
        # The serving thread is at it, or has tried.
        self._thread.join(EXIT_S)
        self._switch_off_directly()

    def readback(self) -> LaserReadback:
        """Read settings and output state back."""
        return readback_from(self._call("readback", self._answer_s))

    def close(self) -> None:
        """Switch off and release; idempotent.

        Raises
        ------
        DeviceError
            When nobody confirms that the output is off; the guard goes on trying for a while.
        """
        if self._closing:
            return
        self._closing = True
        try:
            if self._opened:
                # While the guard's death is still made up for.
                self.disable()
            self._dismissed = True
            if not self._lost:
                self._call("close", OFF_S)
        finally:
            self._dismissed = self._ending = True
            self._thread.join(EXIT_S)
            self._wire.close()
            # It may still be at a generator that does not answer; reaped when it ends.
            threading.Thread(target=self._guard.wait, name="laser guard's end", daemon=True).start()

    def _call(self, command: str, patience_s: float, **arguments: Any) -> Any:
        number = next(self._numbers)
        answers: queue.SimpleQueue[Message] = queue.SimpleQueue()
        self._waiting[number] = answers
        try:
            # Asked after being entered: whoever sets it tells all that are.
            if self._lost:
                # Until it is known whether the output is off.
                self._thread.join(EXIT_S)
                raise DeviceGoneError(self._lost)
            self._wire.send({"id": number, "do": command, **arguments})
            answer = _taken(answers, patience_s)
        except queue.Empty:
            raise DeviceTimeoutError(
                f"laser guard: no answer to {command} within {patience_s:g} s; "
                "check the generator, then configure the laser again"
            ) from None
        finally:
            del self._waiting[number]
        raise_failure(answer)
        return answer["value"]

    def _serve(self) -> None:
        """Hand out answers, tell the guard that this process lives, see that the guard does."""
        poller = select.poll()
        poller.register(self._wire.fileno(), select.POLLIN)
        beat_at_s = 0.0
        while not self._ending:
            poller.poll(_LOOK_S * 1e3)
            messages = self._wire.receive()
            if messages is None:
                break
            for message in messages:
                answers = self._waiting.get(message["id"])
                if answers is not None:
                    answers.put(message)
            now_s = time.monotonic()
            if now_s >= beat_at_s:
                beat_at_s = now_s + self._beat_s
                self._wire.send({"do": "beat"})
            if standing_still(self._guard.pid):
                self._guard.kill()
        if not self._dismissed:
            self._replace_guard()

    def _replace_guard(self) -> None:
        """Do what the guard can no longer do, then tell everybody who waits for it."""
        self._lost = "laser state unknown: its guard is gone"
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._guard.wait(EXIT_S)
        ended = f"laser guard is gone (exit code {self._guard.returncode})"
        if self._opened:
            try:
                self._switch_off_directly()
                self._lost = f"{ended}; output switched off; configure the laser again"
            except Exception as error:
                self._lost = str(error)
        else:
            self._lost = f"{ended} before it opened the generator; look at its message above"
        for answers in list(self._waiting.values()):
            answers.put(failure_message(DeviceGoneError(self._lost)))

    def _switch_off_directly(self) -> None:
        """Open the generator, which the dead guard has released, and close it: it is off then."""
        with self._direct:
            if self._off_confirmed:
                return
            end_s = time.monotonic() + _DIRECT_S
            while not self._off_confirmed:
                try:
                    open_again(self._open_directly, self.identity.serial).close()
                    self._off_confirmed = True
                except EschortyError as error:
                    if time.monotonic() > end_s:
                        raise DeviceError(
                            f"laser state unknown: its guard is gone; {error}"
                        ) from error
                    time.sleep(_LOOK_S)


def _taken(answers: queue.SimpleQueue[Message], patience_s: float) -> Message:
    """Take an answer; raises ``queue.Empty`` when none comes."""
    try:
        return answers.get(timeout=patience_s)
    except queue.Empty:
        # This process may have stood still itself: what has come meanwhile is being handed out.
        return answers.get(timeout=_LATE_S)
