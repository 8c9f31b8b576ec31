"""Receiving from the data endpoint: queued transfers of libusb, or one at a time over pyusb.

pyusb has no queued transfers, so libusb's own are used on the handle that pyusb opened: only one
handle can claim an interface. Unconfirmed on hardware.
"""

from __future__ import annotations

import array
import ctypes
import functools
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Protocol

import usb.backend
import usb.core

from eschorty_ros.core.base.errors import (
    DeviceError,
    DeviceGoneError,
    DeviceStallError,
    DeviceTimeoutError,
)
from eschorty_ros.hardware.base.usb import translate, translated

TRANSFERS = 20
TRANSFER_BYTES = 128 << 10
_TRANSFER_TIMEOUT_MS = 100
_CANCEL_WAITS = 50
_CANCEL_WAIT_S = 0.02
_DRAIN_MAX = 64
_DRAIN_MS = 10
_NAME = "camera: reading events"

ClockNs = Callable[[], int]

# Each with its buffer and callback, which libusb may still use.
_LOST: list[Any] = []


class BulkReader(Protocol):
    """Reads one bulk endpoint, in one thread."""

    def start(self) -> None:
        """Discard what the device still holds, then be ready to receive."""

    def resume(self) -> None:
        """Be ready again after a failed transfer; keeps what the device still holds."""

    def read(self, timeout_s: float) -> tuple[bytes, int]:
        """Return bytes and their arrival time (ns); ``b""`` when none came.

        Raises ``DeviceStallError``, ``DeviceGoneError`` or ``DeviceError``.
        """

    def stop(self) -> None:
        """Stop receiving; idempotent."""


class SyncReader:
    """Reads one transfer at a time over pyusb, into a buffer that is reused.

    Between two reads only the camera's USB bridge buffers data: enough for a line scene,
    unconfirmed on hardware for more.
    """

    def __init__(self, device: usb.core.Device, endpoint: int, clock_ns: ClockNs) -> None:
        self._device = device
        self._endpoint = endpoint
        self._clock_ns = clock_ns
        self._buffer = array.array("B", bytes(TRANSFER_BYTES))
        self._view = memoryview(self._buffer)

    def start(self) -> None:
        """Clear a halt and empty the endpoint."""
        self.resume()
        drain(self._device, self._endpoint, self._buffer)

    def resume(self) -> None:
        """Clear a halt."""
        with translated(_NAME):
            self._device.clear_halt(self._endpoint)

    def read(self, timeout_s: float) -> tuple[bytes, int]:
        """Read one transfer."""
        try:
            # For libusb 0 ms is unlimited.
            count = self._device.read(self._endpoint, self._buffer, max(int(timeout_s * 1e3), 1))
        except usb.core.USBError as error:
            failure = translate(error, _NAME)
            if isinstance(failure, DeviceTimeoutError):
                return b"", self._clock_ns()
            raise failure from error
        return bytes(self._view[:count]), self._clock_ns()

    def stop(self) -> None:
        """Do nothing: no transfer is pending between two reads."""


def lost_transfers() -> int:
    """Return the transfers of this process that libusb did not give back in time, 128 kB each."""
    return len(_LOST)


def drain(device: usb.core.Device, endpoint: int, buffer: array.array[int]) -> None:
    """Read ``endpoint`` until it is empty, at most 64 transfers."""
    with suppress(usb.core.USBError):
        for _ in range(_DRAIN_MAX):
            device.read(endpoint, buffer, _DRAIN_MS)


def make_reader(
    backend: usb.backend.IBackend, device: usb.core.Device, endpoint: int, clock_ns: ClockNs
) -> BulkReader:
    """Return an ``AsyncReader`` on libusb with the package ``libusb1``, else a ``SyncReader``.

    A backend of an emulated bus may give the clock of its transfers.
    """
    if hasattr(backend, "transfer_clock"):
        clock_ns = backend.transfer_clock(clock_ns)
    synchronous = SyncReader(device, endpoint, clock_ns)
    library = _queueing_library(backend)
    if library is None:
        return synchronous
    handle = device._ctx.handle.handle
    return AsyncReader(library, handle, backend.ctx, synchronous, endpoint, clock_ns)


def _queueing_library(backend: usb.backend.IBackend) -> Any | None:
    if type(backend).__module__ != "usb.backend.libusb1":
        return None
    try:
        from usb1 import libusb1
    except ImportError:
        return None
    # A separate library object: declaring prototypes on pyusb's would break pyusb's calls.
    if not libusb1.loadLibrary(_library(backend.lib._name)):
        return None
    return libusb1


@functools.cache
def _library(path: str) -> ctypes.CDLL:
    return ctypes.CDLL(path)


class AsyncReader:
    """Keeps ``TRANSFERS`` bulk reads queued on one endpoint.

    A time-out with data counts as completed, one without is queued again. A stall or an error
    stops the queue until ``resume`` or ``start``.

    - ``library``: ``usb1.libusb1`` on the libusb that opened ``handle``.
    - ``handle``, ``context``: Device handle and context, as pyusb keeps them.
    - ``synchronous``: Clears and empties the endpoint before the first transfer is queued.
    """

    def __init__(
        self,
        library: Any,
        handle: Any,
        context: Any,
        synchronous: SyncReader,
        endpoint: int,
        clock_ns: ClockNs,
    ) -> None:
        self._library = library
        self._handle = ctypes.cast(handle, library.libusb_device_handle_p)
        self._context = ctypes.cast(context, library.libusb_context_p)
        self._synchronous = synchronous
        self._endpoint = endpoint
        self._clock_ns = clock_ns
        self._received: deque[tuple[bytes, int]] = deque()
        self._failure: DeviceError | None = None
        self._stopping = True
        # Addresses; one that was given up is none of them.
        self._pending: set[int] = set()
        self._transfers: list[Any] = []
        self._buffers: list[Any] = []
        self._on_completed = library.libusb_transfer_cb_fn_p(self._completed)

    def start(self) -> None:
        """Empty the endpoint and queue the transfers."""
        self.stop()
        self._synchronous.start()
        self._received.clear()
        self._queue_all()

    def resume(self) -> None:
        """Cancel what is queued, clear the halt, queue again; received data can still be read."""
        self.stop()
        self._synchronous.resume()
        self._queue_all()

    def read(self, timeout_s: float) -> tuple[bytes, int]:
        """Return the oldest completed transfer, handling libusb's events until there is one."""
        if not self._received and self._failure is None:
            self._handle_events(timeout_s)
        if self._received:
            return self._received.popleft()
        if self._failure is not None:
            raise self._failure
        return b"", self._clock_ns()

    def stop(self) -> None:
        """Cancel what is queued and wait for it, at most 1 s; see ``lost_transfers``."""
        self._stopping = True
        for transfer in self._transfers:
            # libusb refuses to cancel a completed transfer, without further effect.
            self._library.libusb_cancel_transfer(transfer)
        for _ in range(_CANCEL_WAITS):
            if not self._pending:
                break
            self._handle_events(_CANCEL_WAIT_S)
        for transfer, buffer in zip(self._transfers, self._buffers, strict=True):
            if _address(transfer) in self._pending:
                # libusb still owns it: freeing it would crash.
                _LOST.append((transfer, buffer, self._on_completed))
            else:
                self._library.libusb_free_transfer(transfer)
        self._transfers, self._buffers, self._pending = [], [], set()

    def _queue_all(self) -> None:
        library = self._library
        self._failure = None
        self._stopping = False
        for _ in range(TRANSFERS):
            transfer = library.libusb_alloc_transfer(0)
            if not transfer:
                raise DeviceError("camera: no memory for USB transfers; close other programs")
            buffer = ctypes.create_string_buffer(TRANSFER_BYTES)
            self._transfers.append(transfer)
            self._buffers.append(buffer)
            library.libusb_fill_bulk_transfer(
                transfer,
                self._handle,
                self._endpoint,
                buffer,
                TRANSFER_BYTES,
                self._on_completed,
                None,
                _TRANSFER_TIMEOUT_MS,
            )
            self._pending.add(_address(transfer))
            self._submit(transfer)

    def _submit(self, transfer: Any) -> None:
        code = self._library.libusb_submit_transfer(transfer)
        if code:
            self._pending.discard(_address(transfer))
            gone = code == self._library.LIBUSB_ERROR_NO_DEVICE
            self._fail(DeviceGoneError if gone else DeviceError, f"not queued (libusb {code})")

    def _completed(self, transfer: Any) -> None:
        """Collect a finished transfer; runs in the thread that handles libusb's events."""
        if _address(transfer) not in self._pending:
            return
        library, done = self._library, transfer.contents
        status = done.status
        # Data after a failed transfer follows a gap that is not marked yet.
        if done.actual_length and self._failure is None:
            data = ctypes.string_at(done.buffer, done.actual_length)
            self._received.append((data, self._clock_ns()))
        finished = status in (library.LIBUSB_TRANSFER_COMPLETED, library.LIBUSB_TRANSFER_TIMED_OUT)
        if finished and not self._stopping and self._failure is None:
            self._submit(transfer)
            return
        self._pending.discard(_address(transfer))
        if status == library.LIBUSB_TRANSFER_STALL:
            self._fail(DeviceStallError, "the endpoint is halted")
        elif status == library.LIBUSB_TRANSFER_NO_DEVICE:
            self._fail(DeviceGoneError, "the camera is gone; check cable and power")
        elif not finished and status != library.LIBUSB_TRANSFER_CANCELLED:
            self._fail(DeviceError, f"transfer status {status}; check cable and hub")

    def _fail(self, kind: type[DeviceError], text: str) -> None:
        if self._failure is None:
            self._failure = kind(f"camera: reading events: {text}")

    def _handle_events(self, timeout_s: float) -> None:
        library = self._library
        wait = library.timeval(int(timeout_s), int(timeout_s % 1.0 * 1e6))
        code = library.libusb_handle_events_timeout(self._context, ctypes.byref(wait))
        if code and code != library.LIBUSB_ERROR_INTERRUPTED:
            self._fail(DeviceError, f"libusb error {code} while handling events")


def _address(transfer: Any) -> int:
    return ctypes.addressof(transfer.contents)
