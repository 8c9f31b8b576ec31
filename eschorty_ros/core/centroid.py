"""Row of the laser line in every column, with its standard deviation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core import _centroid_kernels as kernels
from eschorty_ros.core._checks import number, positive, whole
from eschorty_ros.core.errors import ArgumentError

METHODS = ("mode_mean", "mean", "median")
METHOD_CODES = {
    "mode_mean": kernels.MODE_MEAN,
    "mean": kernels.MEAN,
    "median": kernels.MEDIAN,
}
HALF_WIDTH_PER_FWHM = 1.3
FWHM_PER_SIGMA = 2.3548200450309493
SIGMA_FACTOR = 0.24
SIGMA_FLOOR_PX = 0.20
SIGMA_LIMIT = 1e6
# The median of independent Gaussian samples scatters sqrt(pi/2) times as much as their mean.
_MEDIAN_FACTOR = 1.2533141373155003


@dataclass(frozen=True, slots=True)
class Centroids:
    """One entry per column; NaN (and 0 events) where the column gave no row.

    Attributes
    ----------
    row : float64
        Row of the line, px.
    sigma_row : float64
        Its standard deviation, px.
    width : float64
        Sample standard deviation of the rows used, px.
    events : int64
        Events used.
    ambiguous : bool
        Two separate, equally dense groups of events: no row is given.
    edge : bool
        The first or last row of the sensor cuts the footprint: the row may be off by up to 0.8 of
        the width (half a Gaussian), which ``sigma_row`` includes.
    """

    row: NDArray[np.float64]
    sigma_row: NDArray[np.float64]
    width: NDArray[np.float64]
    events: NDArray[np.int64]
    ambiguous: NDArray[np.bool_]
    edge: NDArray[np.bool_]


def half_width_fixed(fwhm_px: float) -> int:
    """Half width of the averaging window for a line of ``fwhm_px``, fixed point."""
    positive("fwhm_px", fwhm_px)
    return max(round(HALF_WIDTH_PER_FWHM * fwhm_px * kernels.FRACTION), 3 * kernels.FRACTION)


def method_factor(method: str, sigma_factor: float = SIGMA_FACTOR) -> float:
    """Factor on s/sqrt(N) for ``method``."""
    check_method(method)
    number("sigma_factor", sigma_factor, 0.0, SIGMA_LIMIT)
    return sigma_factor * (_MEDIAN_FACTOR if method == "median" else 1.0)


def check_method(method: str) -> int:
    """Code of ``method`` for the kernels; raises ``ArgumentError`` when there is none."""
    if not isinstance(method, str) or method not in METHOD_CODES:
        raise ArgumentError(f"centroid is {method!r}; choose one of {', '.join(METHODS)}")
    return METHOD_CODES[method]


def estimate(
    rows: ArrayLike,
    offsets: ArrayLike,
    method: str = "mode_mean",
    *,
    line_width_px: float = 20.0,
    height: int = 720,
    events_min: int = 1,
    sigma_factor: float = SIGMA_FACTOR,
    sigma_floor_px: float = SIGMA_FLOOR_PX,
) -> Centroids:
    """Row of the line in each column of a CSR layout, every column on its own.

    Parameters
    ----------
    rows : array of integer, shape (N,)
        Rows of the events, 0 to ``height`` - 1, grouped by column in any order.
    offsets : array of int64, shape (columns + 1,)
        Column ``c`` owns ``rows[offsets[c]:offsets[c + 1]]``.
    method : {"mode_mean", "mean", "median"}
        ``mode_mean`` averages the densest window (half width 1.3 x ``line_width_px``, at most 5
        mean-shift steps) and ignores background elsewhere; ``mean`` and ``median`` use the whole
        column (``mean`` is the method of the paper).
    line_width_px : float
        Full width of the line at half maximum, rows.
    height : int
        Rows of the sensor, at most 1023.
    events_min : int
        Columns with fewer events in the window give NaN.
    sigma_factor, sigma_floor_px : float
        ``sigma_row^2 = sigma_factor^2 s^2 / N + sigma_floor_px^2`` with s the sample standard
        deviation of the rows used: counts per pixel and laser edge vary less than Poisson counts,
        and the mismatch of the pixels' thresholds does not average out over one column.

    Returns
    -------
    Centroids

    Notes
    -----
    ``mode_mean`` is exactly symmetric under mirroring and shifting of the rows and does not depend
    on their order. Of equally dense windows the one that ends with more events wins, then the
    narrower one; overlapping ones are merged; two separate equal ones give NaN, since any choice
    would prefer a direction.

    Raises
    ------
    ArgumentError
        When rows, offsets or a parameter lie outside what is described above.
    """
    code = check_method(method)
    row_array = _checked_rows(rows, height)
    offset_array = _checked_offsets(offsets, row_array.size)
    if not 0.5 <= number("line_width_px", line_width_px) <= height:
        raise ArgumentError(f"line_width_px is {line_width_px!r}; choose 0.5 to {height}")
    whole("events_min", events_min, 1, 1 << 31)
    number("sigma_floor_px", sigma_floor_px, 0.0, SIGMA_LIMIT)
    columns = offset_array.size - 1
    longest = int(np.diff(offset_array).max(initial=0))
    scratch = np.empty(longest + kernels.BLOCK, dtype=np.uint32)
    out = Centroids(
        np.empty(columns),
        np.empty(columns),
        np.empty(columns),
        np.empty(columns, dtype=np.int64),
        np.empty(columns, dtype=np.bool_),
        np.empty(columns, dtype=np.bool_),
    )
    status = np.empty(columns, dtype=np.uint8)
    kernels._estimate_lists(
        row_array,
        offset_array,
        code,
        half_width_fixed(line_width_px),
        float(height),
        events_min,
        method_factor(method, sigma_factor),
        sigma_floor_px,
        scratch,
        out.row,
        out.sigma_row,
        out.width,
        out.events,
        status,
    )
    np.sqrt(out.width, out=out.width)
    np.equal(status, kernels.AMBIGUOUS, out=out.ambiguous)
    np.less(np.minimum(out.row, height - 1 - out.row), 2.0 * out.width, out=out.edge)
    return out


def _checked_rows(rows: ArrayLike, height: int) -> NDArray[np.uint32]:
    whole("height", height, 1, kernels.ROW_LAST + 1)
    array = np.asarray(rows)
    if array.ndim != 1 or (array.size and not np.issubdtype(array.dtype, np.integer)):
        raise ArgumentError(
            f"rows has shape {array.shape} and dtype {array.dtype}; give one axis of integers"
        )
    if array.size and not (array.min() >= 0 and array.max() < height):
        raise ArgumentError(
            f"rows span {array.min()} to {array.max()}; the sensor has rows 0 to {height - 1}"
        )
    return array.astype(np.uint32)


def _checked_offsets(offsets: ArrayLike, size: int) -> NDArray[np.int64]:
    array = np.asarray(offsets)
    if array.ndim != 1 or array.size < 1 or not np.issubdtype(array.dtype, np.integer):
        raise ArgumentError(
            f"offsets has shape {array.shape} and dtype {array.dtype}; give one axis of integers"
        )
    wide = array.astype(np.int64)
    if wide[0] != 0 or wide[-1] != size or (np.diff(wide) < 0).any():
        raise ArgumentError(
            f"offsets run from {wide[0]} to {wide[-1]} for {size} rows; "
            "start at 0, never fall, end at the number of rows"
        )
    return wide
