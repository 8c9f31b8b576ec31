"""Targets and distances as CSV files."""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

from eschorty_ros.core.base.errors import ArgumentError, FormatError
from eschorty_ros.core.base.files import atomic_write, read_regular_file
from eschorty_ros.core.base.numbers import file_path, short
from eschorty_ros.core.calibration.post_matching import KnownTarget
from eschorty_ros.core.calibration.targets import SIGMA_ROW_PX, SIGMA_WIDTH_PX, Targets

SIGMA_RANGE_MM = 1.0
"""Standard deviation of a range that was measured by hand."""

_COLUMNS = {
    "row": "row",
    "range_mm": "range_mm",
    "row_sigma": "sigma_row_px",
    "range_sigma_mm": "sigma_range_mm",
    "column": "column",
    "width_px": "width_px",
    "width_sigma_px": "sigma_width_px",
    "size_mm": "size_mm",
    "spacing_px": "spacing_px",
    "spacing_sigma_px": "sigma_spacing_px",
    "spacing_mm": "spacing_mm",
    "shared_sigma_mm": "sigma_shared_mm",
}
TARGET_COLUMNS = (*_COLUMNS, "label")
_BYTES_MAX = 16 << 20
DISTANCE_COLUMNS = ("range_mm", "range_sigma_mm", "size_mm", "column", "row", "label")


def read_targets(
    path: str | os.PathLike[str],
    *,
    sigma_row_px: float = SIGMA_ROW_PX,
    sigma_range_mm: float = SIGMA_RANGE_MM,
) -> Targets:
    """Read targets, one a line.

    - ``path``: CSV with a header line: ``row`` and ``range_mm``, and any of ``row_sigma``,
      ``range_sigma_mm``, ``column``, ``width_px``, ``width_sigma_px``, ``size_mm``, ``spacing_px``,
      ``spacing_sigma_px``, ``spacing_mm``, ``shared_sigma_mm``, ``label``, in any order. An empty
      cell means unknown; lines that begin with ``#`` are comments.
    - ``sigma_row_px``, ``sigma_range_mm``: Standard deviations where the file gives none.

    Raises ``FormatError``, which names file, line or label, column and value.
    Targets are labelled ``line N`` where the file has no label.
    """
    table = _read(file_path("path", path), TARGET_COLUMNS, ("row", "range_mm"))
    default = {
        "row_sigma": sigma_row_px,
        "range_sigma_mm": sigma_range_mm,
        "width_sigma_px": SIGMA_WIDTH_PX,
        "spacing_sigma_px": SIGMA_WIDTH_PX,
        "shared_sigma_mm": 0.0,
    }
    numbers = {
        _COLUMNS[name]: [line.number(name, default.get(name, math.nan)) for line in table]
        for name in _COLUMNS
    }
    labels = [line.text("label") or f"line {line.at}" for line in table]
    try:
        return Targets(**numbers, labels=labels)
    except ArgumentError as error:
        raise FormatError(f"{table[0].path}: {error}") from error


def write_targets(path: str | os.PathLike[str], targets: Targets) -> None:
    """Write targets so that :func:`read_targets` gives the same ones, to the last bit.

    - ``path``: Written atomically.

    Raises ``ArgumentError`` when the file cannot be written.
    """
    columns = [getattr(targets, attribute).tolist() for attribute in _COLUMNS.values()]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(TARGET_COLUMNS)
    for *values, label in zip(*columns, targets.labels, strict=True):
        writer.writerow([*("" if math.isnan(value) else repr(value) for value in values), label])
    with atomic_write(path) as stream:
        stream.write(text.getvalue().encode())


def read_distances(
    path: str | os.PathLike[str], *, sigma_range_mm: float = SIGMA_RANGE_MM
) -> list[KnownTarget]:
    """Read the known distances of the posts of a recording, one a line.

    - ``path``: CSV with a header line: ``range_mm``, and any of ``range_sigma_mm``, ``size_mm``,
      ``column`` and ``row`` (where the post is expected), ``label``.
    - ``sigma_range_mm``: Standard deviation where the file gives none.

    Raises ``FormatError``, which names file, line, column and value.
    """
    return [
        _known(line, sigma_range_mm)
        for line in _read(file_path("path", path), DISTANCE_COLUMNS, ("range_mm",))
    ]


def _known(line: _Line, sigma_range_mm: float) -> KnownTarget:
    try:
        return KnownTarget(
            line.number("range_mm"),
            line.number("range_sigma_mm", sigma_range_mm),
            line.number("size_mm"),
            line.number("column"),
            line.number("row"),
            line.text("label"),
        )
    except ArgumentError as error:
        raise FormatError(f"{line.path} line {line.at}: {error}") from error


@dataclass(frozen=True, slots=True)
class _Line:
    """Cells of one line by column name; ``at`` is its number in the file."""

    path: Path
    at: int
    cells: dict[str, str]

    def text(self, name: str) -> str:
        return self.cells.get(name, "")

    def number(self, name: str, default: float = math.nan) -> float:
        text = self.text(name)
        if not text:
            return default
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise FormatError(
                f"{self.path} line {self.at}: {name} is {short(text)}; write a number, with a "
                "decimal point"
            )
        return value


def _read(path: Path, known: Sequence[str], needed: Sequence[str]) -> list[_Line]:
    reader = csv.reader(io.StringIO(_text(path)), strict=True)
    try:
        lines = [
            (reader.line_num, [cell.strip() for cell in cells])
            for cells in reader
            if any(cell.strip() for cell in cells) and not cells[0].lstrip().startswith("#")
        ]
    except csv.Error as cause:
        raise FormatError(f"{path} line {reader.line_num}: {cause}; give a CSV file") from cause
    if not lines:
        raise FormatError(f"{path}: it has no lines; begin with the header {','.join(needed)}")
    header = lines[0][1]
    _check_header(path, header, known, needed)
    made = []
    for at, cells in lines[1:]:
        if len(cells) != len(header):
            raise FormatError(
                f"{path} line {at}: it has {len(cells)} cells and the header {len(header)}; "
                "write one for each column, empty where unknown, decimals with a point"
            )
        line = _Line(path, at, dict(zip(header, cells, strict=True)))
        for name in needed:
            if not line.text(name):
                raise FormatError(f"{path} line {at}: {name} is empty; write a number")
        made.append(line)
    if not made:
        raise FormatError(f"{path}: it holds a header and no targets; add one line for each")
    return made


def _text(path: Path) -> str:
    try:
        return read_regular_file(path, _BYTES_MAX, FormatError).decode("utf-8-sig")
    except UnicodeDecodeError as cause:
        raise FormatError(f"{path}: it is not text in UTF-8; save it as CSV in UTF-8") from cause


def _check_header(
    path: Path, header: Sequence[str], known: Sequence[str], needed: Sequence[str]
) -> None:
    for name in header:
        if ";" in name or "\t" in name:
            raise FormatError(
                f"{path}: its header is {short(name)}; separate columns by commas, and write "
                "decimals with a point"
            )
        if name not in known:
            near = get_close_matches(name, known, n=1)
            remedy = f"did you mean {near[0]}?" if near else f"choose of {', '.join(known)}"
            raise FormatError(f"{path}: column {short(name)} is not known; {remedy}")
        if header.count(name) > 1:
            raise FormatError(f"{path}: column {short(name)} appears twice; remove one")
    missing = [name for name in needed if name not in header]
    if missing:
        raise FormatError(f"{path}: column {missing[0]!r} is missing; add it to the header")
