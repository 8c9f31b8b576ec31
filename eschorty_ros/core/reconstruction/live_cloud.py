"""The points of a live cloud, whose times count from the stamp of its message."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import exact
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.numbers import TIME_LIMIT, integer
from eschorty_ros.core.storage import POINT_DTYPE, REFLECTANCE_DTYPE


def _live_dtype(scan_dtype: np.dtype[Any]) -> np.dtype[Any]:
    names = scan_dtype.names or ()
    return np.dtype([(name, "<u4" if name == "t" else scan_dtype[name].str) for name in names])


LIVE_DTYPE = _live_dtype(POINT_DTYPE)
"""Point of a live cloud: metres, events used, metres, ns since the stamp, column, flags.

The points of an assembled scan (``POINT_DTYPE``) have ``t`` in seconds as float64: a uint32 of
nanoseconds ends at 4.29 s, shorter than most scans.
"""

LIVE_SPAN_NS = 4_000_000_000
"""Longest time one live cloud may span, just under the range of its uint32 ``t``."""

_LAYOUTS = {dtype: _live_dtype(dtype) for dtype in (POINT_DTYPE, REFLECTANCE_DTYPE)}


def live_points(points: NDArray[Any], t_ns: NDArray[np.int64], stamp_ns: int) -> NDArray[Any]:
    """Return placed points in the layout of a live cloud, ``t`` from ``stamp_ns``.

    - ``points``: POINT_DTYPE or REFLECTANCE_DTYPE, shape (n,); their ``t`` is not used.
    - ``t_ns``: int64, shape (n,), within ``LIVE_SPAN_NS`` after ``stamp_ns``.

    Returns LIVE_DTYPE, with the fields of a reflectance where the points have them. Raises
    ``ArgumentError`` for another dtype or shape.
    """
    layout = _LAYOUTS.get(getattr(points, "dtype", None))  # type: ignore[arg-type]
    if layout is None or points.ndim != 1:
        raise ArgumentError("points is no vector of points; give POINT_DTYPE or REFLECTANCE_DTYPE")
    times_ns = exact("t_ns", t_ns, np.int64, len(points))
    begin_ns = integer("stamp_ns", stamp_ns, -TIME_LIMIT, TIME_LIMIT)
    live = np.empty(len(points), layout)
    for name in layout.names or ():
        live[name] = times_ns - begin_ns if name == "t" else points[name]
    return live
