"""A USB device in memory: identity, endpoints, and the ways a real one fails.

Transfers follow the bus, not Python: data travels in packets of ``wMaxPacketSize``, a short or
empty packet ends a transfer, a time-out loses what had arrived, a packet larger than what is left
of the buffer is an overflow, a halted endpoint refuses until the halt is cleared, and a device
that was plugged in again has a new address, so handles from before stay dead.
"""

from __future__ import annotations

import errno
import itertools
import threading
from dataclasses import dataclass

from eschorty_ros.emulation.bus.usb_pipe import InPipe, UsbFault, Wait

BULK = 2
DIRECTION_IN = 0x80
SPEED_FULL, SPEED_HIGH, SPEED_SUPER = 2, 3, 4

_GET_DESCRIPTOR = 6
_STRING_DESCRIPTOR = 3
_ENGLISH = b"\x04\x03\x09\x04"

_addresses = itertools.count(2)


@dataclass(frozen=True, slots=True)
class EndpointIdentity:
    """A bulk endpoint: address (bit 7 set = to the host) and packet size in bytes."""

    address: int
    max_packet: int = 512


@dataclass(frozen=True, slots=True)
class UsbIdentity:
    """Descriptors of a device with one configuration and one interface."""

    vendor_id: int
    product_id: int
    interface_class: int
    interface_subclass: int
    interface_protocol: int
    endpoints: tuple[EndpointIdentity, ...]
    serial: str = ""
    manufacturer: str = ""
    product: str = ""
    bcd_device: int = 0x0100
    speed: int = SPEED_HIGH


class EmulatedUsbDevice:
    """Base of the models: override ``control``, ``bulk_out``, and ``bulk_in`` where data is pulled.

    Parameters
    ----------
    identity : UsbIdentity
    wait : callable
        How a read waits for data: ``wait(condition, seconds)``, False when nothing came. With
        ``lambda *_: False`` every wait times out at once, for tests without sleeps.

    Attributes
    ----------
    gone : bool
        Unplugged: every transfer fails with ENODEV, the bus no longer lists it.
    stalled : set of int
        Endpoint addresses that refuse with EPIPE until their halt is cleared.
    mute : bool
        The device answers nothing: every transfer times out.
    denied : bool
        Opening fails with EACCES.
    kernel_driver : str or None
        Name of the driver that holds the interface until it is detached.
    address : int
        Address on the bus; a new one after every ``replug``.
    """

    def __init__(self, identity: UsbIdentity, *, wait: Wait = threading.Condition.wait):
        self.identity = identity
        self.bus = 1
        self.address = next(_addresses)
        self.stalled: set[int] = set()
        self.mute = False
        self.denied = False
        self.kernel_driver: str | None = None
        self.detached_driver: str | None = None
        self.claims: dict[int, object] = {}
        self.mutex = threading.RLock()
        self._gone = False
        self._wait = wait
        self._waiting = threading.Condition()
        self._pipes = {
            e.address: InPipe(e.max_packet, wait)
            for e in identity.endpoints
            if e.address & DIRECTION_IN
        }

    @property
    def gone(self) -> bool:
        """Whether the device is unplugged."""
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
        """Come back at a new address, powered up afresh."""
        self.gone = True
        self.address = next(_addresses)
        self.power_up()
        self.gone = False

    def power_up(self) -> None:
        """Take on the state after power-up; models extend it."""
        self.stalled.clear()
        for pipe in self._pipes.values():
            pipe.clear()

    def free(self, owner: object) -> None:
        """Drop the claims of ``owner``; the reads it left behind end at once."""
        with self.mutex:
            held = [interface for interface, holder in self.claims.items() if holder is owner]
            if held:
                # Before somebody else may claim it and read.
                for pipe in self._pipes.values():
                    pipe.cancel()
            for interface in held:
                self.claims.pop(interface, None)

    def reply(self, endpoint: int, data: bytes, *, zero_length: bool = False) -> None:
        """Queue a transfer for the host on an IN endpoint."""
        self._pipes[endpoint].put(data, zero_length=zero_length)

    def pending(self, endpoint: int) -> bool:
        """Whether the host has something to read on an IN endpoint."""
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
        """Answer a control request: bytes for IN (``data`` = bytes wanted), a count for OUT.

        The base knows string descriptors; anything else is a stall.
        """
        if (request_type, request, value >> 8) == (0x80, _GET_DESCRIPTOR, _STRING_DESCRIPTOR):
            return self._string(value & 0xFF)
        raise UsbFault(errno.EPIPE)

    def bulk_out(self, endpoint: int, data: bytes, timeout_ms: int) -> int:
        """Take a transfer from the host; returns the bytes accepted."""
        raise UsbFault(errno.EPIPE)

    def begin_read(self, endpoint: int) -> None:
        """Begin a read in this thread, before its right to read is looked at.

        From now on ``free`` ends it, also when it is to wait only later.
        """
        self._pipes[endpoint].begin()

    def bulk_in(self, endpoint: int, size: int, timeout_ms: int) -> bytes:
        """Give the host a transfer of at most ``size`` bytes; the base takes what ``reply`` put."""
        return self._pipes[endpoint].take(
            size, timeout_ms / 1e3 if timeout_ms else None, lambda: self.check(endpoint)
        )

    def clear_halt(self, endpoint: int) -> None:
        """Let a stalled endpoint work again."""
        self.stalled.discard(endpoint)

    def reset(self) -> None:
        """Bus reset: stalls and unread data go, the address stays."""
        self.stalled.clear()
        for pipe in self._pipes.values():
            pipe.clear()

    def check(self, endpoint: int) -> None:
        """Raise what keeps ``endpoint`` from working now."""
        if self._gone:
            raise UsbFault(errno.ENODEV)
        if endpoint in self.stalled:
            raise UsbFault(errno.EPIPE)

    def before_transfer(self, endpoint: int, timeout_ms: int) -> None:
        """Raise what the switches say of a transfer about to begin (endpoint 0 = control)."""
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
