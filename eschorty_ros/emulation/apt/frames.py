"""APT frames on the controller's side: commands parsed, answers packed."""

from __future__ import annotations

import struct
from collections.abc import Iterator

from eschorty_ros.hardware.stage import apt_messages as apt

_COMMANDS = {layout.id: layout for layout in apt.TO_CONTROLLER.values()}
_ANSWERS = {
    layout.name: layout
    for layouts in apt.FROM_CONTROLLER.values()
    for layout in layouts  # the long form of a message comes last
}


class CommandParser:
    """Commands out of the bytes a host sends; bytes of none are skipped one by one."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> Iterator[tuple[str, int, dict[str, int]]]:
        """Yield name, address and fields of each command that ``data`` completes."""
        buffer = self._buffer
        buffer += data
        while len(buffer) >= apt.HEADER_BYTES:
            id, length = struct.unpack_from("<HH", buffer)
            layout = _COMMANDS.get(id)
            long = bool(buffer[4] & apt.LONG)
            known = layout is not None and long == bool(layout.payload) and buffer[5] == apt.HOST
            if layout is None or not known or (long and length != layout.payload_bytes):
                del buffer[0]
                continue
            size = apt.HEADER_BYTES + layout.payload_bytes
            if len(buffer) < size:
                return
            body = bytes(buffer[:size])
            del buffer[:size]
            fields = (
                struct.unpack_from("<" + layout.payload, body, apt.HEADER_BYTES)
                if layout.payload
                else body[2:4]
            )
            yield layout.name, body[4] & ~apt.LONG, dict(zip(layout.fields, fields, strict=False))


def pack_answer(name: str, source: int, *, reserved_bytes: int, **values: int | bytes) -> bytes:
    """Return the frame of the message ``name`` to the host; fields not given are 0.

    - ``reserved_bytes``: Zeros at its end, where the message may be longer than its fields.
    """
    layout = _ANSWERS[name]
    fields = [values.get(field, 0) for field in layout.fields]
    if layout.payload:
        payload = struct.pack("<" + layout.payload, *fields)
        payload += bytes(reserved_bytes * layout.may_be_longer)
        head = struct.pack("<HHBB", layout.id, len(payload), apt.HOST | apt.LONG, source)
        return head + payload
    first, second = (*fields, 0, 0)[:2]
    return struct.pack("<HBBBB", layout.id, first, second, apt.HOST, source)
