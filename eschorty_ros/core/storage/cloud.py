"""The point type, its height map, and two file forms: binary PCD 0.7 and little-endian PLY."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.errors import ArgumentError, FormatError, OtherFormatError
from eschorty_ros.core.base.files import atomic_write, open_regular_file
from eschorty_ros.core.base.numbers import file_path, integer, short

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

``flags`` are bits, 0 for a good point.
"""

MIXED, SENSOR_EDGE, FEW_EVENTS = 1, 2, 4
"""Bits of a point's flags: the line is on two surfaces, cut by the edge, or of few events."""

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

_PLY_TYPES = {"f4": "float", "f8": "double", "u2": "uint16"}
_HEADER_LIMIT = 4096
# A PCD of one row is a cloud without order.
_HEIGHT_MIN = 2


def write_cloud(path: str | os.PathLike[str], points: Points) -> None:
    """Write ``points`` as ``.pcd`` or ``.ply``; the file appears complete or not at all.

    Parameters
    ----------
    path : path
        Ends in ``.pcd`` or ``.ply``.
    points : ndarray of POINT_DTYPE or REFLECTANCE_DTYPE, shape (n,) or (profiles, columns)
        A height map, as `height_map` returns it, is one of the PCD, too; PLY has none.

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
    if points.dtype not in _DTYPES or points.ndim not in (1, 2):
        raise ArgumentError(
            f"points has dtype {points.dtype} and shape {points.shape}; give a one-dimensional "
            "array of POINT_DTYPE or REFLECTANCE_DTYPE, or a height map of these"
        )
    if header is _ply_header or len(points) < _HEIGHT_MIN:
        points = finite_points(points)
    with atomic_write(path) as stream:
        stream.write(header(points.dtype, points.shape))
        stream.write(np.ascontiguousarray(points).data)


def read_cloud(path: str | os.PathLike[str], *, organized: bool = False) -> Points:
    """Read a cloud that :func:`write_cloud` wrote; without flags in the file they are 0.

    Returns
    -------
    ndarray of POINT_DTYPE or REFLECTANCE_DTYPE, shape (n,)
        Of a height map the points that are there; with ``organized`` all of it, shape
        (profiles, columns).

    Raises
    ------
    ArgumentError
        For an extension other than ``.pcd`` and ``.ply``.
    FormatError
        When the file is missing, truncated, too long, or holds other fields; with ``organized``
        also when it is no height map.
    """
    points = stored_points(path)
    if not organized:
        return finite_points(points)
    if points.ndim == 1:
        raise FormatError(
            f"{path}: its points are no height map; write it as .pcd of a reconstruction with the "
            "setting organized, or read it without organized=True"
        )
    return points


def stored_points(path: str | os.PathLike[str]) -> Points:
    """Read a cloud as `read_cloud` does; a height map remains one, shape (profiles, columns)."""
    source = file_path("path", path)
    if source.is_dir():
        raise FormatError(f"{source} is a folder; give a cloud, such as {source / 'cloud.pcd'}")
    header = _header_writer(source)
    with open_regular_file(source, FormatError) as stream:
        head = stream.read(_HEADER_LIMIT)
        shape, start = _parse_header(source, head)
        count = math.prod(shape)
        kinds = (*_DTYPES, *_UNFLAGGED)
        # As PLY files were written before.
        same = head[:start].replace(b"property ushort ", b"property uint16 ")
        dtype = next((kind for kind in kinds if header(kind, shape) == same), None)
        expected = 0 if dtype is None else count * dtype.itemsize
        found = os.fstat(stream.fileno()).st_size - start
        if dtype is not None and found == expected:
            stream.seek(start)
            points = np.frombuffer(bytearray(stream.read(expected)), dtype, count).reshape(shape)
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


def height_map(points: Points, profile: NDArray[np.integer[Any]], columns: int) -> Points:
    """Return the cloud as a map: one row for each profile, one column for each of the sensor.

    - ``points``: POINT_DTYPE or REFLECTANCE_DTYPE, shape (n,). At most one point in each
      column of a profile.
    - ``profile``: Shape (n,). A number of its own for each profile, increasing with time.
    - ``columns``: Columns of the sensor.

    Where nothing is, all numbers with a fraction are NaN and ``flags`` 0.

    Examples
    --------
    >>> points = np.zeros(3, POINT_DTYPE)
    >>> points["column"] = 0, 2, 1
    >>> np.isnan(height_map(points, np.array([5, 5, 9]), 3)["x"]).tolist()
    [[False, True, False], [True, False, True]]
    """
    numbers, row = np.unique(profile, return_inverse=True)
    made = np.zeros((len(numbers), integer("columns", columns, 1, 1 << 16)), points.dtype)
    for name in points.dtype.names or ():
        if points.dtype[name].kind == "f":
            made[name] = np.nan
    made["column"] = np.arange(columns)
    if len(points) and int(points["column"].max()) >= columns:
        raise ArgumentError(
            f"a point is in column {points['column'].max()} and columns is {columns}; give those "
            "of the sensor"
        )
    made[row, points["column"]] = points
    if np.count_nonzero(np.isfinite(made["x"])) != len(points):
        raise ArgumentError("a column of a profile has two points; set returns to strongest")
    return made


def finite_points(points: Points) -> Points:
    """Return the points of a height map that are there, shape (n,); other clouds as they are."""
    return points if points.ndim == 1 else points[np.isfinite(points["x"])]


def join_points(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Return all points of ``parts``; a field that some of them lack is NaN in theirs, flags 0.

    - ``parts``: The fields of each begin with those of every shorter one.
    """
    known = isinstance(parts, list | tuple) and len(parts) > 0
    if not known or not all(_is_points(part) for part in parts):
        raise ArgumentError(f"parts is {short(parts)}; give a list of arrays of points")
    widest = max((part.dtype for part in parts), key=lambda kind: kind.itemsize)
    # As bytes: numpy copies a structure field by field, which takes 20 times as long.
    whole = np.dtype((np.void, widest.itemsize))
    wide = [np.ascontiguousarray(_widened(part, widest)).view(whole) for part in parts]
    return np.concatenate(wide).view(widest)


def _is_points(part: Any) -> bool:
    return isinstance(part, np.ndarray) and part.ndim == 1 and part.dtype.names is not None


def _widened(points: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    if points.dtype == dtype:
        return points
    wide = np.empty(points.shape, dtype)
    known = points.dtype.names or ()
    for name in dtype.names or ():
        missing = 0 if name == "flags" else np.nan
        wide[name] = points[name] if name in known else missing
    return wide


def is_cloud(path: Path) -> bool:
    """Return whether the name of a file is that of a cloud."""
    return path.suffix.lower() in (".pcd", ".ply")


def _header_writer(path: Path) -> Any:
    if not is_cloud(path):
        raise ArgumentError(
            f"{path} ends in {path.suffix!r}; choose a name that ends in .pcd or .ply"
        )
    return _pcd_header if path.suffix.lower() == ".pcd" else _ply_header


def _fields(dtype: np.dtype[Any]) -> list[tuple[str, np.dtype[Any]]]:
    return [(name, dtype[name]) for name in dtype.names or ()]


def _pcd_header(dtype: np.dtype[Any], shape: tuple[int, ...]) -> bytes:
    height, width = (1, *shape)[-2:]
    fields = _fields(dtype)
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        "FIELDS " + " ".join(name for name, _ in fields),
        "SIZE " + " ".join(str(kind.itemsize) for _, kind in fields),
        "TYPE " + " ".join(kind.kind.upper() for _, kind in fields),
        "COUNT " + " ".join("1" for _ in fields),
        f"WIDTH {width}",
        f"HEIGHT {height}",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {height * width}",
        "DATA binary",
    ]
    return ("\n".join(lines) + "\n").encode()


def _ply_header(dtype: np.dtype[Any], shape: tuple[int, ...]) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {shape[0]}"]
    lines += [f"property {_PLY_TYPES[kind.str[1:]]} {name}" for name, kind in _fields(dtype)]
    return ("\n".join([*lines, "end_header"]) + "\n").encode()


def _parse_header(source: Path, data: bytes) -> tuple[tuple[int, ...], int]:
    """Return the shape of the cloud and the offset of the first point."""
    pcd = source.suffix.lower() == ".pcd"
    end, key = (b"DATA binary\n", b"WIDTH ") if pcd else (b"end_header\n", b"element vertex ")
    stop = data.find(end, 0, _HEADER_LIMIT)
    width = _number_after(key, data, stop)
    height = _number_after(b"HEIGHT ", data, stop) if pcd else 1
    if width is None or height is None:
        raise OtherFormatError(
            f"{source}: no binary {'PCD' if pcd else 'PLY'} header found; "
            "give a cloud that eschorty_ros wrote"
        )
    return (width,) if height < _HEIGHT_MIN else (height, width), stop + len(end)


def _number_after(key: bytes, data: bytes, stop: int) -> int | None:
    begin = data.find(key, 0, max(stop, 0))
    digits = data[begin + len(key) : data.find(b"\n", begin)].strip()
    return int(digits) if begin >= 0 and digits.isdigit() else None
