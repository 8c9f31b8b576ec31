"""What the guarded laser and its guard tell each other, and how each sees the other stand still.

Messages are JSON objects, one per packet of a ``SOCK_SEQPACKET`` pair: the kernel keeps their
bounds, sends them whole or not at all, and ends the stream when either process is gone.
"""

from __future__ import annotations

import json
import socket
from collections.abc import Mapping
from typing import Any

from eschorty_ros.core.base import errors
from eschorty_ros.core.base.errors import DeviceError, EschortyError
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.hardware.base.protocols import LaserOutput, LaserReadback

MESSAGE_MAX_BYTES = 65536

Message = dict[str, Any]

_STANDING_STILL = {"T": "stopped", "t": "stopped by a debugger", "Z": "dead", "X": "dead"}


class Wire:
    """One end of the socket pair. Sending never waits and may be done from any thread."""

    def __init__(self, end: socket.socket) -> None:
        self._end = end

    def fileno(self) -> int:
        """File descriptor, for polling."""
        return self._end.fileno()

    def send(self, message: Mapping[str, Any]) -> bool:
        """Send one message; whether it was taken (not when the other end is gone or stuck)."""
        try:
            self._end.send(json.dumps(message).encode(), socket.MSG_DONTWAIT)
        except OSError:
            return False
        return True

    def receive(self) -> list[Message] | None:
        """Everything that has come, without waiting; ``None`` when the other end is gone."""
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
        """Close this end; the other one sees it."""
        self._end.close()


def standing_still(pid: int) -> str:
    """Why process ``pid`` runs no code of its own, ``""`` while it does.

    A crash that dumps core keeps its descriptors open for as long as the dump takes.
    """
    try:
        with open(f"/proc/{pid}/status", encoding="ascii", errors="replace") as stream:
            status = stream.read()
    except OSError:
        return "gone"
    state = status.partition("\nState:\t")[2][:1]
    if "\nCoreDumping:\t1" in status:
        return "dumping core"
    return _STANDING_STILL.get(state, "")


def failure_message(error: Exception) -> Message:
    """Make the message of an error."""
    if isinstance(error, EschortyError):
        return {"error": type(error).__name__, "text": str(error)}
    return {"error": DeviceError.__name__, "text": f"laser driver failed: {error!r}"}


def raise_failure(message: Message) -> None:
    """Raise the error a message tells of, if it does."""
    if "error" in message:
        raise getattr(errors, message["error"], DeviceError)(message["text"])


def modulation_message(modulation: Modulation) -> Message:
    """Make the message of a modulation."""
    return {
        "frequency_hz": modulation.frequency_hz,
        "duty": modulation.duty,
        "waveform": modulation.waveform,
    }


def readback_message(state: LaserReadback) -> Message:
    """Make the message of a read-back."""
    return {
        "output": int(state.output),
        "modulation": modulation_message(state.modulation),
        "phase_epoch_ns": state.phase_epoch_ns,
        "output_since_ns": state.output_since_ns,
        "reason": state.reason,
        "warnings": state.warnings,
        "counters": dict(state.counters),
    }


def readback_from(message: Message) -> LaserReadback:
    """Take a read-back from its message."""
    return LaserReadback(
        LaserOutput(message["output"]),
        Modulation(**message["modulation"]),
        message["phase_epoch_ns"],
        message["output_since_ns"],
        message["reason"],
        tuple(message["warnings"]),
        message["counters"],
    )
