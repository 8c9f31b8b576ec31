"""Row of the laser line in every column, with its standard deviation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core.base.arrays import number, positive, whole
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.line import _centroid as kernels
from eschorty_ros.core.line._row import likelihood_size
from eschorty_ros.core.line._window import BLOCK, FRACTION, ROW_BITS, ROW_LAST
from eschorty_ros.core.line.row_sigma import (
    OWN_PER_WIDTH2,
    SIGMA_COMMON_PX,
    SIGMA_FACTOR,
    SIGMA_FLOOR_PX,
    noise_of,
)

METHODS = ("mode_mean", "mean", "median", "gauss_ml", "edge_mid")
METHOD_CODES = {
    "mode_mean": kernels.MODE_MEAN,
    "mean": kernels.MEAN,
    "median": kernels.MEDIAN,
    "gauss_ml": kernels.GAUSS_ML,
    "edge_mid": kernels.EDGE_MID,
}
WHOLE_COLUMN_METHODS = ("mean", "median")
RETURNS = ("strongest", "first", "last", "all")
RETURN_CODES = {
    "strongest": kernels.STRONGEST,
    "first": kernels.FIRST,
    "last": kernels.LAST,
    "all": kernels.ALL,
}
HALF_WIDTH_PER_FWHM = 1.3
FWHM_PER_SIGMA = 2.3548200450309493


@dataclass(frozen=True, slots=True)
class Centroids:
    """One entry per column, shape (columns,); NaN (and 0 events) where it gave no row.

    With ``returns="all"`` the arrays but ``ambiguous`` have shape (columns, 2), nearest first.

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
        Two separate, equally dense groups of events where the strongest is asked for: no row.
    edge : bool
        The first or last row of the sensor cuts the footprint, which ``sigma_row`` allows for.
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
    return max(round(HALF_WIDTH_PER_FWHM * fwhm_px * FRACTION), 3 * FRACTION)


def check_method(method: str, returns: str = "strongest") -> tuple[int, int]:
    """Codes of a method and of the returns it reports, for the kernels.

    Raises
    ------
    ArgumentError
        When there is no such method or policy, or the method cannot tell returns apart.
    """
    if not isinstance(method, str) or method not in METHOD_CODES:
        raise ArgumentError(f"centroid is {method!r}; choose one of {', '.join(METHODS)}")
    if not isinstance(returns, str) or returns not in RETURN_CODES:
        raise ArgumentError(f"returns is {returns!r}; choose one of {', '.join(RETURNS)}")
    if method in WHOLE_COLUMN_METHODS and returns != "strongest":
        windowed = [name for name in METHODS if name not in WHOLE_COLUMN_METHODS]
        raise ArgumentError(
            f"returns is {returns!r} and {method!r} takes a column as a whole; choose "
            f"'strongest', or one of {', '.join(windowed)} as centroid"
        )
    return METHOD_CODES[method], RETURN_CODES[returns]


def estimate(
    rows: ArrayLike,
    offsets: ArrayLike,
    method: str = "mode_mean",
    *,
    returns: str = "strongest",
    line_width_px: float = 20.0,
    height: int = 720,
    events_min: int = 1,
    sigma_factor: float = SIGMA_FACTOR,
    sigma_floor_px: float = SIGMA_FLOOR_PX,
    sigma_common_px: float = SIGMA_COMMON_PX,
) -> Centroids:
    """Row of the line in each column of a CSR layout, every column on its own.

    Parameters
    ----------
    rows : array of integer, shape (N,)
        Rows of the events, 0 to ``height`` - 1, grouped by column in any order.
    offsets : array of int64, shape (columns + 1,)
        Column ``c`` owns ``rows[offsets[c]:offsets[c + 1]]``.
    method : {"mode_mean", "mean", "median", "gauss_ml", "edge_mid"}
        ``mode_mean`` averages the densest window (half width 1.3 x ``line_width_px``, at most 5
        mean-shift steps) and ignores background elsewhere. ``gauss_ml`` goes on from there to the
        greatest likelihood of a Gaussian of ``line_width_px`` on uniform background; ``edge_mid``
        takes the middle between the window's quantiles 1/8 and 7/8, the edges of the footprint.
        ``mean`` and ``median`` use the whole column (``mean`` is the method of the paper).
    returns : {"strongest", "first", "last", "all"}
        What to give where a second surface stands behind the first: another window at least
        2 x ``line_width_px`` away whose inner half holds at least half as many events, and more
        than background explains. ``first`` is the one at the least row, hence the nearest.
    line_width_px : float
        Full width of the line at half maximum, rows.
    height : int
        Rows of the sensor, at most 1023.
    events_min : int
        Columns with fewer events in the window give NaN.
    sigma_factor, sigma_floor_px, sigma_common_px : float
        Error model of ``sigma_row``, see `row_sigma`.

    Returns
    -------
    Centroids

    Notes
    -----
    Every method is exactly symmetric under mirroring and shifting of the rows and does not depend
    on their order. Of equally dense windows the one that ends with more events wins, then the
    narrower one; overlapping ones are merged; two separate equal ones give NaN where the strongest
    is asked for, since any choice would prefer a direction, and are both returns otherwise.

    A window that the sensor's edge cuts holds part of a Gaussian: the three windowed methods give
    the row of the whole line (truncated normal), ``mean`` and ``median`` a sigma that covers it.

    Raises
    ------
    ArgumentError
        When rows, offsets or a parameter lie outside what is described above.
    """
    code, policy = check_method(method, returns)
    row_array = _checked_rows(rows, height)
    offset_array = _checked_offsets(offsets, row_array.size)
    if not 0.5 <= number("line_width_px", line_width_px) <= height:
        raise ArgumentError(f"line_width_px is {line_width_px!r}; choose 0.5 to {height}")
    whole("events_min", events_min, 1, 1 << 31)
    noise = noise_of(method, sigma_factor, sigma_floor_px, sigma_common_px)
    half = half_width_fixed(line_width_px)
    estimator = kernels.Estimator(
        code, policy, False, events_min, height, half, OWN_PER_WIDTH2 * line_width_px**2, noise
    )
    columns = _padded_columns(row_array, offset_array)
    found = kernels.empty_rows(2 if returns == "all" else 1, offset_array.size - 1)
    scratch = kernels.Scratch(np.zeros(1 << ROW_BITS, np.int64), np.empty(likelihood_size(half)))
    counters = np.zeros(1, kernels.COUNTERS)[0]
    kernels._estimate_columns(columns, half, estimator, found, scratch, counters)
    one = slice(None) if returns == "all" else 0
    row, sigma, variance, events, cut = (
        np.ascontiguousarray(values.T[:, one])
        for values in (
            found.row,
            np.sqrt(found.sigma2 + found.common2),
            found.variance,
            found.events,
            found.cut,
        )
    )
    return Centroids(row, sigma, np.sqrt(variance), events, found.ambiguous, cut)


def _padded_columns(rows: NDArray[np.uint32], offsets: NDArray[np.int64]) -> kernels.Columns:
    """Return the columns of a CSR layout with room to pad each to whole blocks."""
    counts = np.diff(offsets)
    sizes = -(-counts // BLOCK) * BLOCK
    starts = np.cumsum(sizes) - sizes
    packed = np.empty(int(sizes.sum()), np.uint32)
    packed[np.arange(rows.size) + np.repeat(starts - offsets[:-1], counts)] = rows
    return kernels.Columns(
        packed, starts, counts.astype(np.uint32), np.full(counts.size, -1, np.int64)
    )


def _checked_rows(rows: ArrayLike, height: int) -> NDArray[np.uint32]:
    whole("height", height, 1, ROW_LAST + 1)
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
