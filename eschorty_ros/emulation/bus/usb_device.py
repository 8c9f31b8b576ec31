"""A USB device in memory: identity, endpoints, and the failures of a real one.

Transfers follow the rules of the bus: data travels in packets of ``wMaxPacketSize``, a short or
empty packet ends a transfer, a time-out loses the packets that had arrived, a packet larger than
the rest of the buffer is an overflow, a halted endpoint refuses until the halt is cleared, and a
device that is plugged in again has a new address, so that its old handles stay invalid.
"""

from __future__ import annotations

import errno
import itertools
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

BULK = 2
DIRECTION_IN = 0x80
SPEED_FULL, SPEED_HIGH, SPEED_SUPER = 2, 3, 4

_GET_DESCRIPTOR = 6
_STRING_DESCRIPTOR = 3
_ENGLISH = b"\x04\x03\x09\x04"

_addresses = itertools.count(2)

Wait = Callable[[threading.Condition, float | None], bool]


@dataclass(frozen=True, slots=True)
class EndpointIdentity:
    """A bulk endpoint: address (bit 7 set = to the host) and packet size in bytes."""

    address: int
    max_packet: int


@dataclass(frozen=True, slots=True)
class UsbIdentity:
    """Descriptors of a device with one configuration and one interface."""

    vendor_id: int
    product_id: int
    interface_class: int
    interface_subclass: int
    interface_protocol: int
    endpoints: tuple[EndpointIdentity, ...]
    serial: str
    manufacturer: str
    product: str
    bcd_device: int = 0x0100
    speed: int = SPEED_HIGH


class UsbFault(Exception):  # noqa: N818 -- the backend turns it into pyusb's error
    """A failed transfer, with the kernel's error number."""

    def __init__(self, code: int):
        super().__init__(errno.errorcode[code])
        self.errno = code


class _InPipe:
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


class EmulatedUsbDevice:
    """Base of the models, which override ``control``, ``bulk_out`` and ``bulk_in`` as needed.

    - ``wait``: Waits for data: ``wait(condition, seconds)``, False on a time-out. One that
      returns False makes every wait time out at once, for tests without sleeps.

    Public attributes:
    - ``gone``: Unplugged: every transfer fails with ENODEV, the bus does not list it.
    - ``stalled``: Halted endpoints: they refuse with EPIPE until the halt is cleared.
    - ``mute``: Every transfer times out.
    - ``denied``: Opening fails with EACCES.
    - ``kernel_driver``: Driver that holds the interface until it is detached.
    - ``address``: Address on the bus; a new one after every ``replug``.
    - ``late_ns``: Time by which the data of the last read would have come earlier from a real
      device, because the emulation takes longer.
    """

    def __init__(self, identity: UsbIdentity, *, wait: Wait = threading.Condition.wait):
        self.identity = identity
        self.bus = 1
        self.address = next(_addresses)
        self.stalled: set[int] = set()
        self.mute = False
        self.denied = False
        self.late_ns = 0
        self.kernel_driver: str | None = None
        self.detached_driver: str | None = None
        self.claims: dict[int, object] = {}
        self.mutex = threading.RLock()
        self._gone = False
        self._wait = wait
        self._waiting = threading.Condition()
        self._pipes = {
            e.address: _InPipe(e.max_packet, wait)
            for e in identity.endpoints
            if e.address & DIRECTION_IN
        }

    @property
    def gone(self) -> bool:
        """Return whether the device is unplugged."""
        return self._gone

    @gone.setter
    def gone(self, value: bool) -> None:
        self._gone = value
        if value:
            self.claims.clear()
        with self._waiting:
            self._waiting.notify_all()
        for pipe in self._pipes.values():
            pipe.wake()

    def replug(self) -> None:
        """Plug the device in again: new address, state after power-up."""
        self.gone = True
        self.address = next(_addresses)
        self.power_up()
        self.gone = False

    def power_up(self) -> None:
        """Set the state after power-up; models extend it."""
        self.reset()

    def free(self, owner: object) -> None:
        """Drop the claims of ``owner`` and end its reads."""
        with self.mutex:
            held = [interface for interface, holder in self.claims.items() if holder is owner]
            if held:
                # Before another handle can claim the interface and read.
                for pipe in self._pipes.values():
                    pipe.cancel()
            for interface in held:
                self.claims.pop(interface, None)

    def reply(self, endpoint: int, data: bytes, *, zero_length: bool = False) -> None:
        """Queue a transfer for the host on an IN endpoint."""
        self._pipes[endpoint].put(data, zero_length=zero_length)

    def pending(self, endpoint: int) -> bool:
        """Return whether an IN endpoint has data for the host."""
        return bool(self._pipes[endpoint])

    def control(
        self,
        request_type: int,
        request: int,
        value: int,
        index: int,
        data: bytes | int,
        timeout_ms: int,
    ) -> bytes | int:
        """Answer a control request: bytes for IN (``data`` = bytes requested), a count for OUT.

        The base answers string descriptors and stalls on anything else.
        """
        if (request_type, request, value >> 8) == (0x80, _GET_DESCRIPTOR, _STRING_DESCRIPTOR):
            return self._string(value & 0xFF)
        raise UsbFault(errno.EPIPE)

    def bulk_out(self, endpoint: int, data: bytes, timeout_ms: int) -> int:
        """Receive a transfer from the host; returns the bytes accepted."""
        raise UsbFault(errno.EPIPE)

    def begin_read(self, endpoint: int) -> None:
        """Begin a read in this thread, before its claim is checked.

        From now on ``free`` ends it, even before it waits.
        """
        self._pipes[endpoint].begin()

    def bulk_in(self, endpoint: int, size: int, timeout_ms: int) -> bytes:
        """Send the host a transfer of at most ``size`` bytes that ``reply`` queued."""
        return self._pipes[endpoint].take(
            size, timeout_ms / 1e3 if timeout_ms else None, lambda: self.check(endpoint)
        )

    def clear_halt(self, endpoint: int) -> None:
        """Clear the halt of an endpoint."""
        self.stalled.discard(endpoint)

    def reset(self) -> None:
        """Reset the device: halts and unread data are cleared, the address stays."""
        self.stalled.clear()
        for pipe in self._pipes.values():
            pipe.clear()

    def check(self, endpoint: int) -> None:
        """Raise the fault of a device or endpoint that cannot transfer."""
        if self._gone:
            raise UsbFault(errno.ENODEV)
        if endpoint in self.stalled:
            raise UsbFault(errno.EPIPE)

    def before_transfer(self, endpoint: int, timeout_ms: int) -> None:
        """Raise the fault that the switches cause in a new transfer (endpoint 0 = control)."""
        self.check(endpoint)
        if self.mute:
            with self._waiting:
                if not self._gone:
                    self._wait(self._waiting, timeout_ms / 1e3 if timeout_ms else None)
            raise UsbFault(errno.ENODEV if self._gone else errno.ETIMEDOUT)

    def _string(self, index: int) -> bytes:
        if index == 0:
            return _ENGLISH
        texts = (self.identity.manufacturer, self.identity.product, self.identity.serial)
        if index > len(texts):
            raise UsbFault(errno.EPIPE)
        text = texts[index - 1].encode("utf-16-le")
        return bytes([len(text) + 2, _STRING_DESCRIPTOR]) + text
