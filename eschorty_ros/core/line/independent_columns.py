"""Row of the line in every column of a period, independently of other columns and periods."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core.base.arrays import integer_vector
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.kernel import entry_kernel
from eschorty_ros.core.base.numbers import TIME_LIMIT, integer, number
from eschorty_ros.core.line.blinking import Blink, recent_lines
from eschorty_ros.core.line.centroid import _estimate_columns, empty_rows, make_row_counts
from eschorty_ros.core.line.columns import grouped_columns
from eschorty_ros.core.line.estimators import Estimator, check_method, half_width_fixed
from eschorty_ros.core.line.learned import make_footprint
from eschorty_ros.core.line.sigma import (
    SIGMA_FLOOR_PX,
    VARIANCE_PER_WIDTH2,
    error_model,
)
from eschorty_ros.core.line.window import ROW_LAST


@dataclass(frozen=True, slots=True)
class Centroids:
    """One entry per column, shape (columns,); NaN (and 0 events) where there is no row.

    With ``returns="all"`` the arrays but ``ambiguous`` have shape (columns, 2), nearest first.
    """

    row: NDArray[np.float64]
    sigma_row: NDArray[np.float64]
    """Row of the line and its standard deviation, px."""
    width: NDArray[np.float64]
    """Sample standard deviation of the rows used, px."""
    events: NDArray[np.int64]
    """Events used."""
    ambiguous: NDArray[np.bool_]
    """Two separate, equally dense groups of events with ``returns="strongest"``: no row."""
    edge: NDArray[np.bool_]
    """The first or last row of the sensor cuts the line, which ``sigma_row`` allows for."""


@entry_kernel(_nrt=False)
def _estimate(columns, estimator, blink, footprint, out, row_counts):
    """Estimate the rows of every column into ``out``."""
    _estimate_columns(columns, estimator.half_max, estimator, blink, footprint, out, row_counts)


def estimate(
    rows: ArrayLike,
    offsets: ArrayLike,
    method: str = "mode_mean",
    *,
    returns: str = "strongest",
    line_width_px: float = 20.0,
    height: int = 720,
    sigma_factor: float = 0.0,
) -> Centroids:
    """Return the row of the line in each column, independently of the others.

    Every method is exactly symmetric under mirroring and shifting of the rows and does not depend
    on their order. Of equally dense windows the one that ends with more events is used, then the
    narrower one; overlapping ones are merged; of two separate equal ones the strongest is NaN,
    since any choice would prefer a direction, while the other ``returns`` report them both.

    Where the sensor's edge cuts the line ``sigma_row`` covers the bias of the part that is left. A
    stream corrects it, with the footprint of the line elsewhere.

    - ``rows``: Rows of the events, integers of shape (N,), 0 to ``height`` - 1, grouped by column
      in any order.
    - ``offsets``: Integers of shape (columns + 1,); column ``c`` has the events
      ``rows[offsets[c]:offsets[c + 1]]``.
    - ``method``: ``mode_mean`` averages the densest window (half width 1.3 x ``line_width_px``, at
      most 5 mean-shift steps) and ignores background elsewhere. ``mean`` and ``median`` use the
      full column (``mean`` is the method of the paper).
    - ``returns``: ``strongest``, ``first``, ``last`` or ``all``: the returns to report where a
      column has a second one, another window at least 2 x ``line_width_px`` away whose inner half
      has at least half as many events, and more than background explains. ``first`` is the one at
      the least row, hence the nearest.
    - ``line_width_px``: Full width of the line at half maximum, rows.
    - ``height``: Rows of the sensor, at most 1023.
    - ``sigma_factor``: Error model of ``sigma_row``, see `sigma`.

    Raises ``ArgumentError`` when an argument is not as described above.

    Examples
    --------
    Two columns; the second has a background event at row 40, far from its line.

    >>> found = estimate([300, 301, 302, 299, 300, 301, 40], [0, 3, 7])
    >>> found.row
    array([301., 300.])
    >>> found.events
    array([3, 3])
    """
    integer("height", height, 1, ROW_LAST + 1)
    row_array = integer_vector("rows", rows, np.uint32, 0, height - 1)
    offset_array = _checked_offsets(offsets, row_array.size)
    if not 0.5 <= number("line_width_px", line_width_px) <= height:
        raise ArgumentError(f"line_width_px is {line_width_px!r}; choose 0.5 to {height}")
    if method == "learned":
        raise ArgumentError("method 'learned' follows a stream; choose another for columns alone")
    method_code, returns_code = check_method(method, returns)
    estimator = Estimator(
        method=method_code,
        returns=returns_code,
        seeded=False,
        events_min=1,
        sensor_rows=height,
        rows_taken=height,
        half_max=half_width_fixed(line_width_px),
        line_variance=VARIANCE_PER_WIDTH2 * float(line_width_px) ** 2,
        error_model=error_model(method, sigma_factor, SIGMA_FLOOR_PX),
    )
    found = empty_rows(2 if returns == "all" else 1, offset_array.size - 1)
    columns, row_counts = grouped_columns(row_array, offset_array), make_row_counts()
    footprint, blink = make_footprint(estimator.half_max, columns=0), Blink(lines=recent_lines())
    _estimate(columns, estimator, blink, footprint, found, row_counts)
    by_column = slice(None) if returns == "all" else 0
    row, sigma, width, events, truncated = (
        np.ascontiguousarray(values.T[:, by_column])
        for values in (
            found.row,
            np.sqrt(found.sigma2 + found.common2),
            np.sqrt(found.variance),
            found.events,
            found.truncated,
        )
    )
    return Centroids(row, sigma, width, events, found.ambiguous, truncated)


def _checked_offsets(offsets: ArrayLike, size: int) -> NDArray[np.int64]:
    checked = integer_vector("offsets", offsets, np.int64, 0, TIME_LIMIT)
    if checked.size < 1 or checked[0] != 0 or checked[-1] != size or (np.diff(checked) < 0).any():
        raise ArgumentError(
            f"offsets run from {checked[:1]} to {checked[-1:]} for {size} rows; "
            "start at 0, never fall, end at the number of rows"
        )
    return checked
