"""The point type and its two file forms: binary PCD 0.7 and binary little-endian PLY."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.errors import ArgumentError, FormatError
from eschorty_ros.core.files import atomic_write

POINT_DTYPE = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("intensity", "<f4"),
        ("sigma", "<f4"),
        ("t", "<f8"),
        ("column", "<u2"),
    ]
)
"""Packed, 30 bytes: x y z sigma in metres, intensity in events, t in seconds, column in px."""

Points = NDArray[np.void]

_PLY_TYPES = {"f4": "float", "f8": "double", "u2": "ushort"}
_HEADER_LIMIT = 4096


def write_cloud(path: str | os.PathLike[str], points: Points) -> None:
    """Write ``points`` as ``.pcd`` or ``.ply``; the file appears whole or not at all.

    Parameters
    ----------
    path : path
        Ends in ``.pcd`` or ``.ply``.
    points : ndarray of POINT_DTYPE, shape (n,)

    Raises
    ------
    ArgumentError
        For another extension, another dtype or shape, or a path that cannot be written.
    """
    header = _header_writer(Path(path))
    if points.dtype != POINT_DTYPE or points.ndim != 1:
        raise ArgumentError(
            f"points has dtype {points.dtype} and shape {points.shape}; give a one-dimensional "
            "array of POINT_DTYPE"
        )
    with atomic_write(path) as stream:
        stream.write(header(len(points)))
        stream.write(np.ascontiguousarray(points).data)


def read_cloud(path: str | os.PathLike[str]) -> Points:
    """Read a cloud that :func:`write_cloud` wrote.

    Returns
    -------
    ndarray of POINT_DTYPE, shape (n,)

    Raises
    ------
    ArgumentError
        For an extension other than ``.pcd`` and ``.ply``.
    FormatError
        When the file is missing, truncated, too long, or holds other fields.
    """
    source = Path(path)
    header = _header_writer(source)
    try:
        data = source.read_bytes()
    except OSError as error:
        raise FormatError(
            f"cannot read {source}: {error.strerror or error}; check the path"
        ) from error
    count, start = _parse_header(source, data)
    if header(count) != data[:start]:
        raise FormatError(
            f"{source}: its header is not that of an eschorty_ros cloud; expected the fields "
            f"{' '.join(POINT_DTYPE.names or ())} in binary form, convert the file first"
        )
    expected = count * POINT_DTYPE.itemsize
    if len(data) - start != expected:
        raise FormatError(
            f"{source}: {count} points need {expected} bytes and {len(data) - start} follow the "
            "header; the file is damaged, write it again"
        )
    return np.frombuffer(data, POINT_DTYPE, count, start).copy()


def _header_writer(path: Path) -> Any:
    try:
        return {".pcd": _pcd_header, ".ply": _ply_header}[path.suffix.lower()]
    except KeyError:
        raise ArgumentError(
            f"{path} ends in {path.suffix!r}; choose a name that ends in .pcd or .ply"
        ) from None


def _fields() -> list[tuple[str, np.dtype[Any]]]:
    return [(name, POINT_DTYPE[name]) for name in POINT_DTYPE.names or ()]


def _pcd_header(count: int) -> bytes:
    fields = _fields()
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        "FIELDS " + " ".join(name for name, _ in fields),
        "SIZE " + " ".join(str(kind.itemsize) for _, kind in fields),
        "TYPE " + " ".join(kind.kind.upper() for _, kind in fields),
        "COUNT " + " ".join("1" for _ in fields),
        f"WIDTH {count}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {count}",
        "DATA binary",
    ]
    return ("\n".join(lines) + "\n").encode()


def _ply_header(count: int) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    lines += [f"property {_PLY_TYPES[kind.str[1:]]} {name}" for name, kind in _fields()]
    return ("\n".join([*lines, "end_header"]) + "\n").encode()


def _parse_header(source: Path, data: bytes) -> tuple[int, int]:
    """Find the number of points and the offset of the first one."""
    pcd = source.suffix.lower() == ".pcd"
    end, key = (b"DATA binary\n", b"POINTS ") if pcd else (b"end_header\n", b"element vertex ")
    stop = data.find(end, 0, _HEADER_LIMIT)
    begin = data.find(key, 0, max(stop, 0))
    digits = data[begin + len(key) : data.find(b"\n", begin)].strip()
    if stop < 0 or begin < 0 or not digits.isdigit():
        raise FormatError(
            f"{source}: no binary {'PCD' if pcd else 'PLY'} header found; "
            "give a cloud that eschorty_ros wrote"
        )
    return int(digits), stop + len(end)
