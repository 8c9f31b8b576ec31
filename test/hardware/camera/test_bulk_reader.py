"""Queued transfers at libusb's C interface, with its real structures and a fake bus."""

# ruff: noqa: E402 - without the packages the file skips before it imports what needs them

import ctypes
from types import SimpleNamespace
from typing import Any

import pytest

from eschorty_ros.core.base.errors import DeviceError, DeviceGoneError, DeviceStallError
from eschorty_ros.hardware.camera import bulk_reader
from eschorty_ros.hardware.camera.bulk_reader import (
    TRANSFER_BYTES,
    TRANSFERS,
    AsyncReader,
    SyncReader,
    lost_transfers,
    make_reader,
)

libusb_package = pytest.importorskip("libusb_package", reason="libusb-package is not installed")
pytest.importorskip("usb1", reason="libusb1 is not installed")

import usb.core
from usb1 import libusb1

BACKEND = libusb_package.get_libusb1_backend()
assert bulk_reader._queueing_library(BACKEND) is libusb1


def address(transfer: Any) -> int:
    return ctypes.addressof(transfer.contents)


class Bus:
    """libusb whose transfers complete as a test sets; the rest of its interface is real."""

    def __init__(self) -> None:
        self.queued: list[Any] = []
        self.freed = 0
        self.events: list[tuple[int, bytes]] = []
        self.submit_code = 0
        self.stuck = 0
        """Transfers that cancelling does not end."""

    def __getattr__(self, name: str) -> Any:
        return getattr(libusb1, name)

    def libusb_submit_transfer(self, transfer: Any) -> int:
        if not self.submit_code:
            self.queued.append(transfer)
        return self.submit_code

    def libusb_cancel_transfer(self, transfer: Any) -> int:
        for index, queued in enumerate(self.queued):
            if address(queued) == address(transfer):
                if self.stuck:
                    self.stuck -= 1
                    return 0
                self.queued.insert(0, self.queued.pop(index))
                self.events.insert(0, (libusb1.LIBUSB_TRANSFER_CANCELLED, b""))
                return 0
        return int(libusb1.LIBUSB_ERROR_NOT_FOUND)

    def libusb_free_transfer(self, transfer: Any) -> None:
        assert address(transfer) not in map(address, self.queued)
        self.freed += 1
        libusb1.libusb_free_transfer(transfer)

    def libusb_handle_events_timeout(self, _context: Any, _wait: Any) -> int:
        while self.events and self.queued:
            status, data = self.events.pop(0)
            transfer = self.queued.pop(0)
            done = transfer.contents
            assert (done.endpoint, done.length) == (0x81, TRANSFER_BYTES)
            ctypes.memmove(done.buffer, data, len(data))
            done.actual_length, done.status = len(data), status
            done.callback(transfer)
        return 0


class Empty:
    """A device whose endpoint is empty."""

    def __init__(self) -> None:
        self.cleared: list[int] = []

    def clear_halt(self, endpoint: int) -> None:
        self.cleared.append(endpoint)

    def read(self, *_: Any) -> int:
        raise usb.core.USBTimeoutError("timed out", -7, 110)


@pytest.fixture
def bus() -> Bus:
    return Bus()


@pytest.fixture
def reader(bus: Bus) -> AsyncReader:
    handle, context = ctypes.c_void_p(8), ctypes.c_void_p(16)
    clock = iter(range(10_000))
    synchronous = SyncReader(Empty(), 0x81, lambda: 0)
    return AsyncReader(bus, handle, context, synchronous, 0x81, lambda: next(clock))


COMPLETED = libusb1.LIBUSB_TRANSFER_COMPLETED
TIMED_OUT = libusb1.LIBUSB_TRANSFER_TIMED_OUT


def test_transfers_are_queued_before_the_first_byte_and_again_after_each(
    bus: Bus, reader: AsyncReader
) -> None:
    reader.start()
    assert len(bus.queued) == TRANSFERS
    bus.events = [(COMPLETED, b"abcd"), (TIMED_OUT, b""), (TIMED_OUT, b"ef"), (COMPLETED, b"")]
    assert reader.read(0.1) == (b"abcd", 0)
    assert reader.read(0.1) == (b"ef", 1)
    assert reader.read(0.1)[0] == b""
    assert len(bus.queued) == TRANSFERS
    reader.stop()
    reader.stop()
    assert (bus.queued, bus.freed) == ([], TRANSFERS)


@pytest.mark.parametrize(
    ("status", "kind"),
    [
        (libusb1.LIBUSB_TRANSFER_STALL, DeviceStallError),
        (libusb1.LIBUSB_TRANSFER_NO_DEVICE, DeviceGoneError),
        (libusb1.LIBUSB_TRANSFER_OVERFLOW, DeviceError),
        (libusb1.LIBUSB_TRANSFER_ERROR, DeviceError),
    ],
)
def test_failed_transfer_comes_after_what_was_received(
    bus: Bus, reader: AsyncReader, status: int, kind: type[DeviceError]
) -> None:
    reader.start()
    # Data after the failure lies behind a gap and must not come before the error.
    bus.events = [(COMPLETED, b"abcd"), (status, b""), (COMPLETED, b"late")]
    assert reader.read(0.1)[0] == b"abcd"
    with pytest.raises(kind) as caught:
        reader.read(0.1)
    assert "\n" not in str(caught.value)
    reader.resume()
    assert len(bus.queued) == TRANSFERS
    bus.events = [(COMPLETED, b"efgh")]
    assert reader.read(0.1)[0] == b"efgh"
    reader.stop()
    assert bus.freed == 2 * TRANSFERS


def test_transfer_that_returns_after_the_wait_for_it_does_not_count_in_the_next_stream(
    bus: Bus, reader: AsyncReader
) -> None:
    lost = lost_transfers()
    reader.start()
    bus.stuck = 1
    reader.stop()
    assert lost_transfers() == lost + 1
    assert (len(bus.queued), bus.freed) == (1, TRANSFERS - 1)
    reader.start()
    bus.events = [(COMPLETED, b"late"), (COMPLETED, b"abcd")]
    assert reader.read(0.1)[0] == b"abcd"
    assert reader.read(0.1)[0] == b""
    assert len(bus.queued) == TRANSFERS
    reader.stop()
    assert (bus.queued, bus.freed) == ([], 2 * TRANSFERS - 1)


def test_transfer_that_cannot_be_queued_is_an_error(bus: Bus, reader: AsyncReader) -> None:
    bus.submit_code = libusb1.LIBUSB_ERROR_NO_DEVICE
    reader.start()
    with pytest.raises(DeviceGoneError):
        reader.read(0.1)
    reader.stop()
    assert bus.freed == TRANSFERS


def test_emulated_backend_is_read_synchronously() -> None:
    assert isinstance(make_reader(object(), Empty(), 0x81, lambda: 0), SyncReader)


def test_real_libusb_is_read_with_queued_transfers() -> None:
    opened = Empty()
    opened._ctx = SimpleNamespace(handle=SimpleNamespace(handle=ctypes.c_void_p(8)))
    assert isinstance(make_reader(BACKEND, opened, 0x81, lambda: 0), AsyncReader)
