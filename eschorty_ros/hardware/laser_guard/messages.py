"""Messages between a guarded laser and its guard process.

They are JSON objects, one per packet of a ``SOCK_SEQPACKET`` connection: the kernel keeps their
bounds, sends each completely or not at all, and ends the stream when either process is gone.
"""

from __future__ import annotations

import contextlib
import json
import socket
from collections.abc import Mapping
from typing import Any

from eschorty_ros.core.base import errors
from eschorty_ros.core.base.errors import DeviceError, EschortyError
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.hardware.base.protocols import LaserOutput, LaserReadback
from eschorty_ros.hardware.laser.in_flight import VoidedError

MESSAGE_MAX_BYTES = 65536
_ERRORS = {**vars(errors), VoidedError.__name__: VoidedError}

Message = dict[str, Any]


class Wire:
    """One end of the connection. Sending never waits; any thread may send."""

    def __init__(self, end: socket.socket) -> None:
        self._end = end

    def fileno(self) -> int:
        """Return the file descriptor, for polling."""
        return self._end.fileno()

    def send(self, message: Mapping[str, Any]) -> None:
        """Send one message; it is lost when the other end is gone or does not read."""
        with contextlib.suppress(OSError):
            self._end.send(json.dumps(message).encode(), socket.MSG_DONTWAIT)

    def receive(self) -> list[Message] | None:
        """Return every message that has arrived, ``None`` when the other end is gone."""
        messages: list[Message] = []
        while True:
            try:
                packet = self._end.recv(MESSAGE_MAX_BYTES, socket.MSG_DONTWAIT)
            except BlockingIOError:
                return messages
            except OSError:
                packet = b""
            if not packet:
                return messages or None
            messages.append(json.loads(packet))

    def close(self) -> None:
        """Close this end; the other one notices it."""
        self._end.close()


def failure_message(error: Exception) -> Message:
    """Return the message of an error."""
    if isinstance(error, EschortyError):
        return {"error": type(error).__name__, "text": str(error)}
    return {"error": DeviceError.__name__, "text": f"laser driver failed: {error!r}"}


def raise_failure(message: Message) -> None:
    """Raise the error that a message carries, if it carries one."""
    if "error" in message:
        raise _ERRORS.get(message["error"], DeviceError)(message["text"])


def readback_from(message: Message) -> LaserReadback:
    """Return the read-back whose fields ``dataclasses.asdict`` made a message of."""
    fields = {
        "output": LaserOutput(message["output"]),
        "modulation": Modulation(**message["modulation"]),
        "warnings": tuple(message["warnings"]),
    }
    return LaserReadback(**{**message, **fields})
