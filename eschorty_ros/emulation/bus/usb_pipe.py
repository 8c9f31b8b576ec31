"""Data queued for the host in one IN endpoint of an emulated USB device."""

from __future__ import annotations

import errno
import threading
from collections import deque
from collections.abc import Callable

Wait = Callable[[threading.Condition, float | None], bool]


class UsbFault(Exception):  # noqa: N818 -- the backend turns it into pyusb's error
    """A failed transfer, with the kernel's error number."""

    def __init__(self, code: int):
        super().__init__(errno.errorcode[code])
        self.errno = code


class InPipe:
    """Queue of one IN endpoint."""

    def __init__(self, max_packet: int, wait: Wait):
        self._max_packet = max_packet
        self._wait = wait
        self._queue: deque[memoryview] = deque()
        self._changed = threading.Condition()
        self._cancelled = 0
        # Per reading thread: the number of cancellations before its read began.
        self._begun = threading.local()

    def __bool__(self) -> bool:
        return bool(self._queue)

    def put(self, data: bytes | memoryview, *, zero_length: bool = False) -> None:
        """Queue a transfer; ``zero_length`` appends an empty packet, for one of full packets."""
        with self._changed:
            self._queue.append(memoryview(data))
            if zero_length and len(data):
                self._queue.append(memoryview(b""))
            self._changed.notify_all()

    def clear(self) -> None:
        """Discard unread data."""
        with self._changed:
            self._queue.clear()

    def wake(self) -> None:
        """Make waiting reads check the device again."""
        with self._changed:
            self._changed.notify_all()

    def cancel(self) -> None:
        """End pending reads: the handle that reads was closed."""
        with self._changed:
            self._cancelled += 1
            self._changed.notify_all()

    def begin(self) -> None:
        """Begin a read in this thread: ``cancel`` ends it, even before ``take`` waits."""
        self._begun.cancelled = self._cancelled

    def take(self, size: int, timeout_s: float | None, check: Callable[[], None]) -> bytes:
        """Return one transfer of at most ``size`` bytes, as a host controller does.

        ``check`` raises when the device can no longer deliver.
        """
        parts: list[memoryview] = []
        room = size
        with self._changed:
            cancelled = self._begun.__dict__.pop("cancelled", self._cancelled)
            while True:
                check()
                if cancelled != self._cancelled:
                    raise UsbFault(errno.ENODEV)
                while self._queue:
                    data = self._queue.popleft()
                    if len(data) > room:
                        parts.append(self._split(data, room))
                        return b"".join(parts)
                    parts.append(data)
                    room -= len(data)
                    if len(data) % self._max_packet or not len(data) or not room:
                        return b"".join(parts)
                if not self._wait(self._changed, timeout_s):
                    # Packets that had arrived are lost with the cancelled transfer.
                    raise UsbFault(errno.ETIMEDOUT)

    def _split(self, data: memoryview, room: int) -> memoryview:
        fitting = room - room % self._max_packet
        if fitting < room or not room:
            rest = data[fitting + self._max_packet :]
            if len(rest):
                self._queue.appendleft(rest)
            raise UsbFault(errno.EOVERFLOW)
        self._queue.appendleft(data[fitting:])
        return data[:fitting]
