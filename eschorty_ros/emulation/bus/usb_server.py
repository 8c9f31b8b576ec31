"""An emulated bus for other processes: a server on a Unix socket.

Every opened device has one link without transfers. When that link ends, also because the client's
process ended, the claim is freed and pending reads end, as in the kernel. Transfers have links of
their own, one per endpoint, so that a waiting read delays no other request.
"""

from __future__ import annotations

import errno
import itertools
import json
import os
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import usb.core

from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.emulation.bus.usb_backend import EmulatedBackend, Handle
from eschorty_ros.emulation.bus.usb_device import EmulatedUsbDevice
from eschorty_ros.emulation.bus.usb_wire import NUMBERS, Closed, Op, receive_request, send_answer


class UsbServer:
    """Serves the models on a Unix socket until closed.

    - ``path``: Path of the socket; a socket left by an earlier server is replaced.
    - ``models``: Returns the devices on the bus.

    Raises ``DeviceError`` when the socket cannot be made.
    """

    def __init__(
        self, path: str | os.PathLike[str], models: Callable[[], Sequence[EmulatedUsbDevice]]
    ):
        self._backend = EmulatedBackend(models)
        self._path = Path(path)
        self._handles: dict[int, Handle] = {}
        self._tokens = itertools.count(1)
        self._links: set[socket.socket] = set()
        self._closed = False
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._path.unlink(missing_ok=True)
            self._listener.bind(str(self._path))
            self._listener.listen(64)
        except OSError as error:
            self._listener.close()
            raise DeviceError(
                f"USB socket {path}: {error.strerror or error}; give a short path that is writable"
            ) from error
        threading.Thread(target=self._accept, name="usb-server", daemon=True).start()

    def __enter__(self) -> UsbServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def clients(self) -> int:
        """Return the number of open links."""
        return len(self._links)

    def close(self) -> None:
        """Stop serving; the devices of the clients are then unplugged."""
        self._closed = True
        self._path.unlink(missing_ok=True)
        for link in (self._listener, *tuple(self._links)):
            with suppress(OSError):
                link.shutdown(socket.SHUT_RDWR)
            link.close()

    def _accept(self) -> None:
        while not self._closed:
            try:
                link, _ = self._listener.accept()
            except OSError:
                return
            self._links.add(link)
            threading.Thread(target=self._serve, args=(link,), name="usb-link", daemon=True).start()

    def _serve(self, link: socket.socket) -> None:
        session = _Session(self._backend, self._handles, self._tokens)
        try:
            while True:
                op, numbers, data = receive_request(link)
                try:
                    answer = session.run(op, numbers, data)
                except usb.core.USBError as error:
                    send_answer(link, error.errno or errno.ENODEV, late_ns=session.late_ns)
                else:
                    send_answer(link, 0, answer, session.late_ns)
        except (Closed, OSError):
            pass
        finally:
            session.end()
            self._links.discard(link)
            link.close()


class _Session:
    """One link: it opened a device, or joined an opened one to carry transfers."""

    def __init__(self, backend: EmulatedBackend, handles: dict[int, Handle], tokens: Iterator[int]):
        self._backend = backend
        self._handles = handles
        self._tokens = tokens
        self._token = 0
        self._handle: Handle | None = None
        self.late_ns = 0
        self._buffer = memoryview(bytearray(0))

    def run(self, op: Op, numbers: tuple[int, int, int, int], data: bytearray) -> Any:
        if op == Op.LIST:
            return self._list()
        if op == Op.OPEN:
            return self._open(numbers[0])
        if op == Op.JOIN:
            self._handle = self._handles.get(numbers[0])
        handle = self._handle
        if handle is None:
            raise usb.core.USBError("no such handle", -4, errno.ENODEV)
        if op == Op.JOIN:
            return b""
        if op == Op.READ:
            return self._read(handle, *numbers[:3])
        if op == Op.CONTROL:
            return self._control(handle, numbers, data)
        if op == Op.WRITE:
            count = self._backend.bulk_write(handle, numbers[0], 0, data, numbers[1])
            return count.to_bytes(4, "little")
        result = getattr(self._backend, op.name.lower())(handle, *numbers[: NUMBERS[op]])
        return int(result or 0).to_bytes(4, "little")

    def end(self) -> None:
        """Close the device that this link opened."""
        if self._token and self._handle:
            self._handles.pop(self._token, None)
            self._backend.close_device(self._handle)

    def _list(self) -> bytes:
        entries = [
            {"bus": h.bus, "address": h.address, "identity": asdict(h.identity)}
            for h in self._backend.enumerate_devices()
        ]
        return json.dumps(entries).encode()

    def _open(self, address: int) -> bytes:
        for handle in self._backend.enumerate_devices():
            if handle.address == address:
                self._handle = self._backend.open_device(handle)
                self._token = next(self._tokens)
                self._handles[self._token] = self._handle
                return self._token.to_bytes(4, "little")
        raise usb.core.USBError("no such device", -4, errno.ENODEV)

    def _read(self, handle: Handle, endpoint: int, size: int, timeout: int) -> memoryview:
        if size > len(self._buffer):
            self._buffer = memoryview(bytearray(size))
        into = self._buffer[:size]
        try:
            return into[: self._backend.bulk_read(handle, endpoint, 0, into, timeout)]
        finally:
            self.late_ns = handle.device.late_ns

    def _control(
        self, handle: Handle, numbers: tuple[int, int, int, int], data: bytearray
    ) -> memoryview:
        request, value_index, size, timeout = numbers
        kind, value, index = request >> 8, value_index >> 16, value_index & 0xFFFF
        to_host = bool(kind & 0x80)
        buffer = memoryview(bytearray(size) if to_host else data)
        count = self._backend.ctrl_transfer(
            handle, kind, request & 0xFF, value, index, buffer, timeout
        )
        return buffer[:count] if to_host else memoryview(count.to_bytes(4, "little"))
