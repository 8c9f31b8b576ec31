"""Prophesee RAW files: ASCII header of ``% key value`` lines, then EVT3 words.

Source: Prophesee's public RAW format description. Old files lack the closing ``% end``; their
header stops at the first two bytes that are not ``% ``.
"""

from __future__ import annotations

import datetime
import mmap
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from eschorty_ros.core.base.arrays import byte_view, integer_vector
from eschorty_ros.core.base.errors import ArgumentError, FormatError
from eschorty_ros.core.base.files import GrowingFile, atomic_write, open_regular_file
from eschorty_ros.core.base.numbers import file_path, integer
from eschorty_ros.core.evt3 import Encoder, EventArrays, sort_readout
from eschorty_ros.core.evt3 import words as w3

CHUNK_BYTES = 128 * 1024
_HEADER_MAX_BYTES = 64 * 1024
_SIZE_MAX = 2048
# A decoder takes the first time as less than what 24 bits hold.
_BEGIN_MAX_US = (1 << 24) - 1
_EVENTS_AT_ONCE = 1 << 20
_GZIP = b"\x1f\x8b"
_VERSIONS = {"2.0": "EVT2", "2.1": "EVT21", "3.0": "EVT3"}
_REMEDY = "record with format EVT3, or write its events with eschorty_ros.write_events_raw"


class Header(Mapping[str, str]):
    """The header's keys and values as written, plus their meaning.

    ``width``, ``height`` : sensor size in pixels (1280 x 720 when the file has none).
    ``size_bytes`` : offset of the first word.
    """

    def __init__(self, values: dict[str, str], width: int, height: int, size_bytes: int) -> None:
        self._values = values
        self.width = width
        self.height = height
        self.size_bytes = size_bytes

    @property
    def named_size(self) -> tuple[int, int]:
        """Width and height that the file names, zeros when it names none."""
        named = "geometry" in self or "width=" in self.get("format", "")
        return (self.width, self.height) if named else (0, 0)

    def __getitem__(self, key: str) -> str:
        return self._values[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)


class RawReader:
    """Streaming reader of one EVT3 RAW file.

    Parameters
    ----------
    path : path-like
        The file; its header is read at once, its words by ``chunks``.

    Attributes
    ----------
    header : Header
    warnings : list of str
        One line per fault that does not stop the reading: no header, no ``% end``, no geometry, no
        events, an odd last byte. The last appears when ``chunks`` or ``mapped`` is at the end.

    Raises
    ------
    FormatError
        When the file is missing, unreadable, empty, not EVT3, or its header contradicts itself.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = file_path("path", path)
        self.warnings: list[str] = []
        with open_regular_file(self.path, FormatError) as file:
            head = file.read(_HEADER_MAX_BYTES)
            self.size_bytes = os.fstat(file.fileno()).st_size
        if not head:
            raise FormatError(f"{self.path} is empty; record it again")
        self.header = self._parse(head)
        if self.size_bytes <= self.header.size_bytes:
            self._warn("holds a header and no events")

    def chunks(self, size: int = CHUNK_BYTES, begin: int = 0) -> Iterator[bytes]:
        """Iterate over the words' bytes in pieces of ``size`` bytes, the last one shorter.

        ``begin`` is the number of bytes to leave out before them.

        Raises ``ArgumentError`` when ``size`` is not positive or ``begin`` negative.
        """
        integer("size", size, 1, 1 << 40)
        return self._chunks(size, integer("begin", begin, 0, 1 << 62))

    def __iter__(self) -> Iterator[bytes]:
        return self.chunks()

    def mapped(self, size: int) -> Iterator[memoryview]:
        """Iterate over the words' bytes as `chunks` does, without copies: views of a memory map.

        The pages of a view are given back to the system when the next one is asked for.

        Raises ``FormatError`` when the file has become shorter meanwhile.
        """
        integer("size", size, mmap.PAGESIZE, 1 << 40)
        first = self.header.size_bytes
        with open_regular_file(self.path, FormatError) as file:
            end = os.fstat(file.fileno()).st_size
            if end <= first:
                return
            pages = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        for begin in range(first, end, size):
            # The process would end at a page that is gone.
            if pages.size() < end:
                raise FormatError(f"{self.path} became shorter while it was read; read it again")
            yield memoryview(pages)[begin : begin + size]
            page = begin - begin % mmap.PAGESIZE
            pages.madvise(mmap.MADV_DONTNEED, page, min(begin + size, end) - page)
        self._check_end(end - first)

    def _check_end(self, total: int) -> None:
        if total % 2:
            self._warn("ends in the middle of a word; its last byte is not decoded")

    def _chunks(self, size: int, begin: int) -> Iterator[bytes]:
        total = begin
        with open_regular_file(self.path, FormatError) as file:
            file.seek(self.header.size_bytes + begin)
            while piece := file.read(size):
                total += len(piece)
                yield piece
        self._check_end(total)

    def _warn(self, what: str) -> None:
        line = f"{self.path} {what}"
        if line not in self.warnings:
            self.warnings.append(line)

    def _parse(self, head: bytes) -> Header:
        values: dict[str, str] = {}
        at = 0
        ended = False
        while head.startswith(b"% ", at) and not ended:
            stop = head.find(b"\n", at)
            if stop < 0:
                raise FormatError(
                    f"{self.path} has a header line without end within {len(head)} bytes; "
                    "the file is cut or no RAW file: record it again"
                )
            key, _, value = head[at + 2 : stop].decode("latin-1").strip().partition(" ")
            at = stop + 1
            ended = key == "end"
            if not ended:
                values[key] = " ".join(value.split())
        if not values and not ended and not head.startswith(b"% "):
            if head.startswith(_GZIP):
                raise FormatError(f"{self.path} is compressed with gzip; run gunzip on it")
            if not self._looks_like_evt3(head, 0):
                raise FormatError(
                    f"{self.path} has no RAW header (first bytes {head[:8].hex(' ')}); "
                    "name a Prophesee RAW file"
                )
            self._warn("has no header; taken as EVT3, 1280x720")
        elif not ended:
            self._warn("has no '% end'; its header is taken to stop where the '% ' lines do")
        stated = "format" in values or "evt" in values
        if not stated and self.size_bytes > at and not self._looks_like_evt3(head, at):
            raise FormatError(
                f"{self.path} names no format and its words are not EVT3's; convert it to EVT3"
            )
        width, height = self._meaning(values)
        return Header(values, width, height, at)

    @staticmethod
    def _looks_like_evt3(head: bytes, at: int) -> bool:
        """Return whether a file has EVT3 words from ``at`` on, TIME_HIGH among them."""
        kinds = [byte >> 4 for byte in head[at + 1 : at + 4096 : 2]]
        return w3.TIME_HIGH in kinds and not any(kind in w3.UNUSED for kind in kinds)

    def _meaning(self, values: dict[str, str]) -> tuple[int, int]:
        name, *options = values.get("format", "").split(";")
        version = values.get("evt", "")
        declared = name or _VERSIONS.get(version, f"evt {version}" if version else "EVT3")
        if declared.upper() != "EVT3":
            raise FormatError(f"{self.path} is {declared}, not EVT3; {_REMEDY}")
        if name and version and version != "3.0":
            raise FormatError(
                f"{self.path} has format {name} and evt {version}; correct one of the two"
            )
        sizes = []
        option = dict(part.strip().split("=", 1) for part in options if "=" in part)
        if "width" in option or "height" in option:
            sizes.append(self._size(f"{option.get('width')}x{option.get('height')}", "format"))
        if "geometry" in values:
            sizes.append(self._size(values["geometry"], "geometry"))
        if not sizes:
            if values:
                self._warn("names no geometry; taken as 1280x720")
            return 1280, 720
        if len(set(sizes)) > 1:
            (width, height), (other_width, other_height) = sizes
            raise FormatError(
                f"{self.path} has {width}x{height} in format and {other_width}x{other_height} in "
                "geometry; correct one of the two"
            )
        return sizes[0]

    def _size(self, text: str, key: str) -> tuple[int, int]:
        match = re.fullmatch(r"(\d{1,4})x(\d{1,4})", text)
        width, height = (int(group) for group in match.groups()) if match else (0, 0)
        if not (1 <= width <= _SIZE_MAX and 1 <= height <= _SIZE_MAX):
            raise FormatError(
                f"{self.path} has {key} {text!r}; a sensor size such as 1280x720 belongs there"
            )
        return width, height


class RawWriter(GrowingFile):
    """Writes an EVT3 RAW file with the header keys that older and newer readers need.

    - ``path``: Replaced when it exists.
    - ``width``, ``height``: Sensor size in pixels.

    Raises ``ArgumentError`` for a size that is none. Raises ``FormatError`` when
    the file cannot be written.
    """

    def __init__(self, path: str | Path, width: int = 1280, height: int = 720) -> None:
        for name, size in (("width", width), ("height", height)):
            integer(name, size, 1, _SIZE_MAX)
        super().__init__(file_path("path", path))
        self.bytes_written = 0
        super().write(_header(width, height))

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Append bytes of the stream, all or none."""
        view = byte_view("data", data)
        super().write(view)
        self.bytes_written += len(view)


def _header(width: int, height: int) -> bytes:
    header = {
        "camera_integrator_name": "Prophesee",
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M:%S"),
        "evt": "3.0",
        "format": f"EVT3;height={height};width={width}",
        "generation": "4.2",
        "geometry": f"{width}x{height}",
        "integrator_name": "Prophesee",
        "plugin_integrator_name": "Prophesee",
        "plugin_name": "hal_plugin_prophesee",
        "sensor_generation": "4.2",
        "sensor_name": "IMX636",
        "serial_number": "00000000",
        "system_ID": "49",
    }
    lines = "".join(f"% {key} {value}\n" for key, value in header.items())
    return f"{lines}% end\n".encode("ascii")


def write_events_raw(
    path: str | os.PathLike[str],
    t_us: ArrayLike,
    column: ArrayLike,
    row: ArrayLike,
    polarity: ArrayLike,
    columns: int,
    rows: int,
) -> None:
    """Write ``events.raw`` at ``path`` from events of any camera.

    Parameters
    ----------
    path : path
        The file.
    t_us : array_like of int, shape (n,)
        Sensor time from 0 on, in any order; the first event within 16 s.
    column, row : array_like of int, shape (n,)
        Pixel; the first row sees the nearest range.
    polarity : array_like of bool or int, shape (n,)
        1 where the light increases, else 0.
    columns, rows : int
        Sensor size in pixels, that of the calibration, up to 2048.

    Raises
    ------
    ArgumentError
        When there are no events, the arrays differ in length, a value is outside its range, more
        than an hour passes without events or the path cannot be written.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = f"{folder}/events.raw"
    ...     write_events_raw(path, [100, 230], [39, 40], [50, 51], [1, 0], columns=640, rows=480)
    ...     sum(map(len, RawReader(path)))
    14
    """
    columns, rows = integer("columns", columns, 1, _SIZE_MAX), integer("rows", rows, 1, _SIZE_MAX)
    events = EventArrays(
        integer_vector("t_us", t_us, np.int64, 0, np.iinfo(np.int64).max),
        integer_vector("column", column, np.uint16, 0, columns - 1),
        integer_vector("row", row, np.uint16, 0, rows - 1),
        integer_vector("polarity", polarity, np.uint8, 0, 1),
    )
    sizes = [values.size for values in events]
    if len(set(sizes)) > 1 or not sizes[0]:
        raise ArgumentError(
            f"t_us, column, row, polarity have {sizes} entries; give one of each per event"
        )
    begin_us = int(events.t.min())
    if begin_us > _BEGIN_MAX_US:
        raise ArgumentError(
            f"t_us begins at {begin_us}; subtract that, also from the stage's times"
        )
    events = sort_readout(*events)
    encoder = Encoder(columns, rows)
    with atomic_write(path) as raw:
        raw.write(_header(columns, rows))
        for begin in range(0, sizes[0], _EVENTS_AT_ONCE):
            raw.write(encoder.encode(*(v[begin : begin + _EVENTS_AT_ONCE] for v in events)))
