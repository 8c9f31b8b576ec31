"""The point type and its two file forms: binary PCD 0.7 and binary little-endian PLY."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import file_path, short
from eschorty_ros.core.base.errors import ArgumentError, FormatError, OtherFormatError
from eschorty_ros.core.base.files import atomic_write, open_regular_file

POINT_DTYPE = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("intensity", "<f4"),
        ("sigma", "<f4"),
        ("t", "<f8"),
        ("column", "<u2"),
        ("flags", "<u2"),
    ]
)
"""Packed, 32 bytes: x y z sigma in metres, intensity in events, t in seconds, column in px.

``flags`` are bits of ``FLAGS``, 0 for a good point.
"""

MIXED, SENSOR_EDGE, FEW_EVENTS = 1, 2, 4
FLAGS = {"mixed": MIXED, "sensor_edge": SENSOR_EDGE, "few_events": FEW_EVENTS}
"""Bits of a point's flags: the line is on two surfaces, cut by the sensor's edge, or weak."""

REFLECTANCE_DTYPE = np.dtype(
    [*POINT_DTYPE.descr, ("reflectance", "<f4"), ("reflectance_sigma", "<f4")]
)
"""POINT_DTYPE with the relative reflectance and its standard deviation, 40 bytes."""

Points = NDArray[np.void]

_DTYPES = (POINT_DTYPE, REFLECTANCE_DTYPE)
# Clouds written before points had flags.
_UNFLAGGED = {
    np.dtype([item for item in kind.descr if item[0] != "flags"]): kind for kind in _DTYPES
}

_PLY_TYPES = {"f4": "float", "f8": "double", "u2": "ushort"}
_HEADER_LIMIT = 4096


def write_cloud(path: str | os.PathLike[str], points: Points) -> None:
    """Write ``points`` as ``.pcd`` or ``.ply``; the file appears complete or not at all.

    Parameters
    ----------
    path : path
        Ends in ``.pcd`` or ``.ply``.
    points : ndarray of POINT_DTYPE or REFLECTANCE_DTYPE, shape (n,)

    Raises
    ------
    ArgumentError
        For another extension, another dtype or shape, or a path that cannot be written.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> points = np.zeros(2, POINT_DTYPE)
    >>> points["x"] = 1.0, 1.1
    >>> with TemporaryDirectory() as folder:
    ...     write_cloud(f"{folder}/cloud.pcd", points)
    ...     read_cloud(f"{folder}/cloud.pcd")["x"].tolist()
    [1.0, 1.100000023841858]
    """
    header = _header_writer(file_path("path", path))
    if not isinstance(points, np.ndarray):
        raise ArgumentError(f"points is {short(points)}; give an array of POINT_DTYPE")
    if points.dtype not in _DTYPES or points.ndim != 1:
        raise ArgumentError(
            f"points has dtype {points.dtype} and shape {points.shape}; give a one-dimensional "
            "array of POINT_DTYPE or REFLECTANCE_DTYPE"
        )
    with atomic_write(path) as stream:
        stream.write(header(points.dtype, len(points)))
        stream.write(np.ascontiguousarray(points).data)


def read_cloud(path: str | os.PathLike[str]) -> Points:
    """Read a cloud that :func:`write_cloud` wrote; without flags in the file they are 0.

    Returns
    -------
    ndarray of POINT_DTYPE or REFLECTANCE_DTYPE, shape (n,)

    Raises
    ------
    ArgumentError
        For an extension other than ``.pcd`` and ``.ply``.
    FormatError
        When the file is missing, truncated, too long, or holds other fields.
    """
    source = file_path("path", path)
    header = _header_writer(source)
    with open_regular_file(source, FormatError) as stream:
        head = stream.read(_HEADER_LIMIT)
        count, start = _parse_header(source, head)
        kinds = (*_DTYPES, *_UNFLAGGED)
        dtype = next((kind for kind in kinds if header(kind, count) == head[:start]), None)
        expected = 0 if dtype is None else count * dtype.itemsize
        found = os.fstat(stream.fileno()).st_size - start
        if dtype is not None and found == expected:
            stream.seek(start)
            points = np.frombuffer(bytearray(stream.read(expected)), dtype, count)
            return _widened(points, _UNFLAGGED.get(dtype, dtype))
    if dtype is None:
        raise OtherFormatError(
            f"{source}: its header is not that of an eschorty_ros cloud; expected the fields "
            f"{' '.join(POINT_DTYPE.names or ())} in binary form, convert the file first"
        )
    raise FormatError(
        f"{source}: {short(count)} points need {short(expected)} bytes and {found} follow the "
        "header; the file is damaged, write it again"
    )


def join_points(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Return all points of ``parts``; a field that some of them lack is NaN in theirs, flags 0.

    Parameters
    ----------
    parts : sequence of structured arrays, at least one
        The fields of each begin with those of every shorter one.
    """
    known = isinstance(parts, list | tuple) and len(parts) > 0
    if not known or not all(_is_points(part) for part in parts):
        raise ArgumentError(f"parts is {short(parts)}; give a list of arrays of points")
    widest = max((part.dtype for part in parts), key=lambda kind: kind.itemsize)
    return np.concatenate([_widened(part, widest) for part in parts])


def _is_points(part: Any) -> bool:
    return isinstance(part, np.ndarray) and part.ndim == 1 and part.dtype.names is not None


def _widened(points: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    if points.dtype == dtype:
        return points
    wide = np.empty(len(points), dtype)
    known = points.dtype.names or ()
    for name in dtype.names or ():
        missing = 0 if name == "flags" else np.nan
        wide[name] = points[name] if name in known else missing
    return wide


def _header_writer(path: Path) -> Any:
    try:
        return {".pcd": _pcd_header, ".ply": _ply_header}[path.suffix.lower()]
    except KeyError:
        raise ArgumentError(
            f"{path} ends in {path.suffix!r}; choose a name that ends in .pcd or .ply"
        ) from None


def _fields(dtype: np.dtype[Any]) -> list[tuple[str, np.dtype[Any]]]:
    return [(name, dtype[name]) for name in dtype.names or ()]


def _pcd_header(dtype: np.dtype[Any], count: int) -> bytes:
    fields = _fields(dtype)
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


def _ply_header(dtype: np.dtype[Any], count: int) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    lines += [f"property {_PLY_TYPES[kind.str[1:]]} {name}" for name, kind in _fields(dtype)]
    return ("\n".join([*lines, "end_header"]) + "\n").encode()


def _parse_header(source: Path, data: bytes) -> tuple[int, int]:
    """Return the number of points and the offset of the first one."""
    pcd = source.suffix.lower() == ".pcd"
    end, key = (b"DATA binary\n", b"POINTS ") if pcd else (b"end_header\n", b"element vertex ")
    stop = data.find(end, 0, _HEADER_LIMIT)
    begin = data.find(key, 0, max(stop, 0))
    digits = data[begin + len(key) : data.find(b"\n", begin)].strip()
    if stop < 0 or begin < 0 or not digits.isdigit():
        raise OtherFormatError(
            f"{source}: no binary {'PCD' if pcd else 'PLY'} header found; "
            "give a cloud that eschorty_ros wrote"
        )
    return int(digits), stop + len(end)
