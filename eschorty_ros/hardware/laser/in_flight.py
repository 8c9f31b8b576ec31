"""The one way by which a command in flight becomes void when the laser is disabled."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from eschorty_ros.core.base.errors import DeviceError


class VoidedError(DeviceError):
    """The output was disabled after the command had been requested."""


class CommandsInFlight:
    """Voids every command that was requested before the end of the latest ``disabling``.

    A command takes a ticket when it is requested, and checks it before each step towards light.
    The supervisor, the guard and the generator's driver hold one each: a disabling voids what
    waits at its own level before it waits for any lock. Thread-safe.

    Public attributes:
    - ``disabling_now``: Disablings in progress; a ticket is void during them, also one that was
      taken meanwhile.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._disablings = 0
        self._reason = ""
        self.disabling_now = 0

    def ticket(self) -> int:
        """Return the ticket of a command that is requested now."""
        return self._disablings

    def is_void(self, ticket: int) -> bool:
        """Return whether the output was disabled since the ticket was taken, or is being so."""
        with self._lock:
            return self.disabling_now > 0 or ticket != self._disablings

    def refuse_void(self, ticket: int) -> None:
        """Raise ``VoidedError`` with the reason of the disabling for a void ticket."""
        if self.is_void(ticket):
            raise VoidedError(f"laser refused: {self._reason}")

    @contextmanager
    def disabling(self, reason: str) -> Iterator[None]:
        """Void all tickets from the start of the block to its end."""
        with self._lock:
            self.disabling_now += 1
            self._reason = reason
        try:
            yield
        finally:
            with self._lock:
                self._disablings += 1
                self.disabling_now -= 1
