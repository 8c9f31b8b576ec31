"""Binary frames between the server of an emulated bus and its clients.

A request is an operation, four numbers and data; an answer is an error number (0 = done),
the lateness of a read, and data.
"""

from __future__ import annotations

import socket
import struct
from enum import IntEnum

_REQUEST = struct.Struct("<BxxxIIIII")
_ANSWER = struct.Struct("<IIq")


class Op(IntEnum):
    """Operations; those of ``NUMBERS`` have the names of methods of pyusb's backend."""

    LIST = 0
    OPEN = 1
    JOIN = 2
    CONTROL = 3
    WRITE = 4
    READ = 5
    CLAIM_INTERFACE = 6
    RELEASE_INTERFACE = 7
    SET_INTERFACE_ALTSETTING = 8
    GET_CONFIGURATION = 9
    CLEAR_HALT = 10
    RESET_DEVICE = 11
    IS_KERNEL_DRIVER_ACTIVE = 12
    DETACH_KERNEL_DRIVER = 13
    ATTACH_KERNEL_DRIVER = 14


NUMBERS = {
    Op.CLAIM_INTERFACE: 1,
    Op.RELEASE_INTERFACE: 1,
    Op.SET_INTERFACE_ALTSETTING: 2,
    Op.GET_CONFIGURATION: 0,
    Op.CLEAR_HALT: 1,
    Op.RESET_DEVICE: 0,
    Op.IS_KERNEL_DRIVER_ACTIVE: 1,
    Op.DETACH_KERNEL_DRIVER: 1,
    Op.ATTACH_KERNEL_DRIVER: 1,
}
"""Count of numbers of each operation that is only forwarded to the backend."""


Request = tuple[Op, tuple[int, int, int, int], bytearray]


class Closed(Exception):  # noqa: N818 -- an end, not an error
    """The other side closed the link."""


def receive_into(link: socket.socket, view: memoryview) -> None:
    """Fill ``view``; raises ``Closed`` when the link ends first."""
    while view.nbytes:
        count = link.recv_into(view)
        if not count:
            raise Closed
        view = view[count:]


def _receive(link: socket.socket, size: int) -> bytearray:
    data = bytearray(size)
    receive_into(link, memoryview(data))
    return data


def send_request(link: socket.socket, op: Op, numbers: tuple[int, ...], data: bytes) -> None:
    """Send a request; missing numbers are 0."""
    padded = (*numbers, 0, 0, 0, 0)[:4]
    link.sendall(_REQUEST.pack(op, *padded, len(data)) + data)


def receive_request(link: socket.socket) -> Request:
    """Wait for a request."""
    op, a, b, c, d, size = _REQUEST.unpack(_receive(link, _REQUEST.size))
    return Op(op), (a, b, c, d), _receive(link, size)


def send_answer(
    link: socket.socket, code: int, data: bytes | memoryview = b"", late_ns: int = 0
) -> None:
    """Send an answer."""
    link.sendall(_ANSWER.pack(code, len(data), late_ns))
    if len(data):
        link.sendall(data)


def receive_answer(link: socket.socket) -> tuple[int, int, int]:
    """Wait for the header of an answer; returns error number, size of the data and lateness."""
    code, size, late_ns = _ANSWER.unpack(_receive(link, _ANSWER.size))
    return code, size, late_ns
