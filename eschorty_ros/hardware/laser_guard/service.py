"""The laser's guard as a service of its own: it outlives the laser node's container.

``python -m eschorty_ros.hardware.laser_guard.service /run/eschorty/guard.sock``; the laser node's
parameter ``guard`` names the same socket. Each laser node that connects gets a guard process, one
after the other. Ends with SIGTERM or SIGINT; a guard that serves then goes on until its owner ends.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import struct
import sys
from collections.abc import Iterator
from pathlib import Path

from eschorty_ros.core.base.errors import DeviceError, EschortyError
from eschorty_ros.hardware.laser_guard.starting import start_guard

_CREDENTIALS = struct.Struct("3i")
_BACKLOG = 4
_CONNECT_S = 2.0


def serve(path: str) -> None:
    """Serve at the socket ``path`` until a signal ends the process.

    Raises ``DeviceError`` when the socket cannot be made, or another process serves it.
    """
    with _listening(path) as listener:
        print(f"laser guard: at {path}", flush=True)
        while True:
            end, _ = listener.accept()
            with end:
                pid, user, _ = _CREDENTIALS.unpack(
                    end.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
                )
                if user not in (0, os.getuid()):
                    print(f"laser guard: refused a process of user {user}", flush=True)
                    continue
                # 0 for a process of another process id space, such as another container's.
                guard = start_guard(end, pid)
            guard.wait()


@contextlib.contextmanager
def _listening(path: str) -> Iterator[socket.socket]:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with listener:
        try:
            if _served(path):
                raise DeviceError(f"guard socket {path}: another guard serves it; end that first")
            Path(path).unlink(missing_ok=True)
            # This user alone may connect: a client names the code that opens the generator.
            mask = os.umask(0o177)
            try:
                listener.bind(path)
            finally:
                os.umask(mask)
            listener.listen(_BACKLOG)
        except OSError as error:
            raise DeviceError(
                f"guard socket {path}: {error.strerror or error}; choose a short path that is "
                "writable"
            ) from error
        try:
            yield listener
        finally:
            Path(path).unlink(missing_ok=True)


def _served(path: str) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as other:
        other.settimeout(_CONNECT_S)
        try:
            other.connect(path)
        except (TimeoutError, BlockingIOError):
            # Its backlog is full.
            return True
        except OSError:
            return False
        return True


def main() -> int:
    """Entry point; a stated failure is one line and exit code 1."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    if len(sys.argv) != 2:
        print("usage: python -m eschorty_ros.hardware.laser_guard.service SOCKET", file=sys.stderr)
        return 2
    try:
        serve(sys.argv[1])
    except EschortyError as error:
        print(f"laser guard: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        pass
    return 0


if __name__ == "__main__":
    sys.exit(main())
