"""Starting a guard process, or connecting to the service that starts it."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import threading
from pathlib import Path

from eschorty_ros.core.base.errors import DeviceGoneError

_CONNECT_S = 2.0
# The guard runs the package that runs here, wherever it lies, and searches no current folder: with
# -P and the package's own folder on the path no longer than it takes to find the package.
_START_GUARD = (
    "import sys; sys.path.insert(0, sys.argv.pop(1)); import eschorty_ros; del sys.path[0]; "
    "from eschorty_ros.hardware.laser_guard.guard import main; main()"
)
_PACKAGE_FOLDER = str(Path(__file__).parents[3])


def start_guard(end: socket.socket, owner_pid: int) -> subprocess.Popen[bytes]:
    """Start a guard process with its end of the wire, in a session and group of its own."""
    arguments = (_PACKAGE_FOLDER, str(end.fileno()), str(owner_pid))
    return subprocess.Popen(
        [sys.executable, "-P", "-c", _START_GUARD, *arguments],
        stdin=subprocess.DEVNULL,
        pass_fds=(end.fileno(),),
        start_new_session=True,
    )


class OwnGuard:
    """A guard process that this process has started.

    Public attributes:
    - ``end``: This process's end of the wire.
    """

    def __init__(self) -> None:
        # Both ends close on exec; only the guard is given its end.
        self.end, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with there:
            self._process = start_guard(there, os.getpid())
        self.pid = self._process.pid

    def wait_until_lost(self) -> None:
        """Wait until it has ended or is stopped."""
        with contextlib.suppress(ChildProcessError):
            os.waitid(os.P_PID, self.pid, os.WEXITED | os.WSTOPPED | os.WNOWAIT)

    def kill(self) -> None:
        """End it at once."""
        self._process.kill()

    def ending(self, timeout_s: float) -> str:
        """Return how it has ended, after waiting for that."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout_s)
        return f"laser guard is gone (exit code {self._process.returncode})"

    def release(self) -> None:
        """Wait for its end in the background: it may still retry on a generator without answers."""
        threading.Thread(target=self._process.wait, name="laser guard's end", daemon=True).start()


class ServedGuard:
    """A guard process that the service at a socket has started; attributes as ``OwnGuard``.

    Raises ``DeviceGoneError`` when nothing serves the socket.
    """

    pid = 0

    def __init__(self, path: str) -> None:
        self.end = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        # The backlog of a service that hangs may be full.
        self.end.settimeout(_CONNECT_S)
        try:
            self.end.connect(path)
            self.end.settimeout(None)
        except OSError as error:
            self.end.close()
            raise DeviceGoneError(
                f"laser guard at {path}: {error.strerror or error}; start its service"
            ) from error
        self._lost = threading.Event()

    def wait_until_lost(self) -> None:
        """Wait until it has ended."""
        self._lost.wait()

    def kill(self) -> None:
        """End the wire: the guard switches off and ends."""
        with contextlib.suppress(OSError):
            self.end.shutdown(socket.SHUT_RDWR)
        self._lost.set()

    def ending(self, timeout_s: float) -> str:
        """Return how it has ended."""
        return "laser guard's service is gone"

    def release(self) -> None:
        """Do nothing more: the service waits for its end."""
        self._lost.set()
