"""Points on two surfaces: their line is narrower or wider than those of the stream, or beside it.

An edge of range or reflectance within the line's thickness leaves a part of the line, or two parts
side by side, and moves the row by up to half of the change of the full width. A width is unusual
when few lines of the stream have it for longer than a profile: the width of a line that a step
crosses changes, that on a dark surface stays. Where stripes or many edges make all widths usual,
one that changes is compared with the last that was steady, or else with the mode of all. An edge
leaves one end of the line where it is: where the row does not move with the width, the light has
changed. A width that changes evenly for longer than an edge takes is that of a curved surface. Row
and width change together from column to column, too, where an edge is oblique, and over many
profiles where it is slow.

The lens spreads light over near columns. At an edge that crosses the line, columns have light of
both sides: their row is between those beside them, and their line is wider than either. Where a
stream has many such edges these widths are usual, too.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import kernel, record
from eschorty_ros.core.line.blocks import BLOCK_COLUMNS
from eschorty_ros.core.line.line_history import (
    PER_WIDTH,
    RECENT_PROFILES,
    STEADY,
    STEADY_PROFILES,
    _compare_with_recent,
    _same_for,
)
from eschorty_ros.core.line.reflectance import ROOT_12
from eschorty_ros.core.line.scatter import APART
from eschorty_ros.core.line.smoothing import WIDTH_COLUMNS, WIDTH_PAIRS
from eschorty_ros.core.line.width_trend import WidthTrend, _follow_widths, empty_trend

# Widths that are separated, per row and in all.
_PER_ROW = 16
_BINS = 1 << 10
# A width is usual when this share of the stream's points is within one standard deviation of it: a
# normal distribution alone leaves out 3 in 1000.
_USUAL_SHARE = 0.02
# Weight of a point with an unusual width.
_MIXED_WEIGHT = 0.25
# The same where the row moves.
_MOVING_WEIGHT = 0.05
# Points without which no width is usual.
_POINTS_MIN = 512.0
# Points that count, in profiles of all columns.
_PROFILES_KEPT = 256
# The widths that a window begins with count as this many profiles.
_PROFILES_KNOWN = 16
# Steps of the running median of differences are this share of it, larger ones at first.
_STEP = 1.0 / 1024.0
# Standard deviation over the median size of second differences.
_SIGMA_PER_MEDIAN = 1.0 / 1.652
# Columns to either side that move as a column does.
_BESIDE = BLOCK_COLUMNS + BLOCK_COLUMNS // 2
# A point is marked when the missing or additional rows may move it by more deviations of a row
# that is not smoothed.
_MARKED = 2.5
# Columns to either side that show the width of lines beside a column: more than an object has.
_BROAD = 128


class UsualWidths(NamedTuple):
    """Points by width; ``typical`` are median and mode, and the median of second differences.

    ``scale`` is the width of lines over that of those beside a column, 1 where these are wider.
    """

    number: NDArray[np.float64]
    scale: NDArray[np.float64]
    typical: Any


class Widths(NamedTuple):
    """Widths (standard deviations of the rows) of a stream's smoothed points.

    ``below`` has the sums of the points by width. ``static_width`` holds the widths of a profile
    less what motion adds, ``last`` and ``last_row`` widths and rows of the last one. The
    ``same_width`` has been the same for ``same`` profiles; ``steady``, with ``steady_row``, is the
    last that was for some. Means over recent profiles are ``recent`` and ``recent_row``.
    """

    usual: UsualWidths
    below: NDArray[np.float64]
    static_width: NDArray[np.float64]
    last: NDArray[np.float64]
    last_row: NDArray[np.float64]
    same_width: NDArray[np.float64]
    same: NDArray[np.float64]
    steady: NDArray[np.float64]
    steady_row: NDArray[np.float64]
    recent: NDArray[np.float64]
    recent_row: NDArray[np.float64]
    trend: WidthTrend


def empty_widths(shape: tuple[int, int], rows: int) -> Widths:
    """Return no widths of profiles of a ``shape``, on a sensor of ``rows``."""
    return Widths(
        usual=empty_usual_widths(shape[1]),
        below=np.zeros(_BINS + 1),
        static_width=np.full(shape, np.nan),
        last=np.full(shape, np.nan),
        last_row=np.full(shape, np.nan),
        same_width=np.full(shape, np.nan),
        same=np.zeros(shape),
        steady=np.full(shape, np.nan),
        steady_row=np.full(shape, np.nan),
        recent=np.full(shape, np.nan),
        recent_row=np.full(shape, np.nan),
        trend=empty_trend(shape[1], rows),
    )


def empty_usual_widths(columns: int) -> UsualWidths:
    """Return no usual widths."""
    typical = record("median", "mode", "difference", value=0.0)
    return UsualWidths(np.zeros(_BINS), np.ones(columns), typical)


@kernel
def _width_bin(width):
    return min(np.int64(width * _PER_ROW), _BINS - 1)


@kernel(_nrt=True)
def _keep_widths(widths, known):
    """Keep the usual widths as ``known`` ones, which count as many profiles.

    With them is kept how much wider steady lines are than those beside a column, if they are.
    """
    points, usual = _PROFILES_KNOWN * widths.last.shape[1], widths.usual
    known.number[:] = usual.number * (points / max(usual.number.sum(), 1.0))
    known.typical.difference = usual.typical.difference
    steady, median = np.flatnonzero(~np.isnan(widths.steady[0])), np.nanmedian(widths.steady[0])
    known.scale[:] = 1.0
    # It changes little from a column to those beside.
    for c in steady[::4]:
        # As many on both sides: the median of what falls evenly is that of the middle.
        reach = max(min(c - steady[0], steady[-1] - c, _BROAD), _BROAD // 4)
        beside = np.nanmedian(widths.steady[0, max(c - reach, 0) : c + reach + 1])
        # Wider lines have other light in them, and one of a single row has no width.
        known.scale[c : c + 4] = max(median / beside, 1.0) if beside > 0.0 else 1.0


@kernel
def _reach(columns, sigma):
    """Return the standard deviation, in bins, of a width that is a mean of this many ``columns``.

    ``sigma`` is that of the mean of `WIDTH_COLUMNS`, px.
    """
    share = WIDTH_COLUMNS / min(columns, WIDTH_COLUMNS)
    return np.int64(max(np.rint(sigma * np.sqrt(share) * _PER_ROW), 1.0))


@kernel(inline="always")
def _near(below, place, reach):
    """Return the number of points whose widths are this many bins from ``place`` at most."""
    return below[min(place + reach + 1, _BINS)] - below[max(place - reach, 0)]


@kernel
def _update(widths, columns):
    """Bring the sums and typical widths up to date; halve the numbers when there are many points.

    Where edges or stripes make widths many, the median may be that of no line: the mode is the
    width that most points have, within one standard deviation.
    """
    typical = widths.usual.typical
    number, below = widths.usual.number, widths.below
    if below[_BINS] > _PROFILES_KEPT * columns:
        number *= 0.5
    total = 0.0
    for b in range(_BINS):
        total += number[b]
        below[b + 1] = total
    median = 0
    while median < _BINS - 1 and 2.0 * below[median + 1] < total:
        median += 1
    reach = _reach(WIDTH_COLUMNS, _SIGMA_PER_MEDIAN * typical.difference)
    mode, most = 0, 0.0
    for b in range(_BINS):
        if number[b] > 0.0:
            near = _near(below, b, reach)
            if near > most:
                mode, most = b, near
    typical.median, typical.mode = (median + 0.5) / _PER_ROW, (mode + 0.5) / _PER_ROW


@kernel
def _restart_widths(widths, known):
    """Clear all widths but the ``known`` ones, zeros where there are none."""
    widths.usual.number[:], widths.usual.scale[:] = known.number, known.scale
    widths.usual.typical.difference = known.typical.difference
    widths.last[:], widths.last_row[:], widths.same_width[:] = np.nan, np.nan, np.nan
    widths.steady[:], widths.steady_row[:] = np.nan, np.nan
    widths.recent[:], widths.recent_row[:] = np.nan, np.nan
    widths.below[:] = 0.0
    _update(widths, widths.last.shape[1])


@kernel(_nrt=False)
def _is_known(widths):
    """Return whether enough points have shown what width is usual."""
    return widths.below[_BINS] >= _POINTS_MIN


@kernel(_nrt=False)
def _is_usual(below, width, reach):
    return _near(below, _width_bin(width), reach) >= _USUAL_SHARE * below[_BINS]


@kernel
def _unusual_variance(width, usual):
    """Return the variance of a row, px squared, whose line has not the ``usual`` width.

    A line with missing rows is off by half of them at most, one with more by what they scatter.
    """
    if width < usual:
        return (PER_WIDTH * (usual - width)) ** 2
    return width * width - usual * usual


@kernel(_nrt=False)
def _mixed_variance(rows, smoothing, k, c, sigma_width):
    """Return the variance of a row that is the mean of two surfaces, px squared, else 0.

    It is between the rows two columns to either side, and that of a choice between these two. Its
    line is wider by that, where a slope leaves the width as it is: half decides.
    """
    row, smoothed = smoothing.row, smoothing.width
    pairs = np.intp(WIDTH_PAIRS)
    left, right = c - pairs, c + pairs
    if left < 0 or right >= row.shape[1]:
        return 0.0
    mixed2 = (row[k, c] - row[k, left]) * (row[k, right] - row[k, c])
    if not mixed2 > _MARKED**2 * rows.sigma2[k, c]:
        return 0.0
    beside, variance = max(smoothed[k, left], smoothed[k, right]), rows.variance[k, c]
    wider = np.sqrt(variance) - beside > STEADY * sigma_width
    return mixed2 if wider and 2.0 * (variance - beside * beside) > mixed2 else 0.0


@kernel(_nrt=False)
def _oblique_variance(smoothing, widths, k, c, sigma_width):
    """Return the variance of a row at an edge that is oblique to the line, px squared, else 0.

    Such an edge leaves more of the line from column to column, and one end where it is: row and
    width change together, and not as the light on the columns does.
    """
    before, after = c - APART, c + APART
    if before < 0 or after >= smoothing.row.shape[1]:
        return 0.0
    width, mode, least = widths.static_width, widths.usual.typical.mode, STEADY * sigma_width
    wider = abs(width[k, after] - width[k, before])
    if not min(mode - width[k, c], wider) > least:
        return 0.0
    moved, scale = abs(smoothing.row[k, after] - smoothing.row[k, before]), widths.usual.scale
    at_edge = 0.5 * PER_WIDTH * wider < moved < 2.0 * PER_WIDTH * wider
    missing = mode - scale[c] * width[k, c]
    evenly = abs(scale[after] * width[k, after] - scale[before] * width[k, before])
    return (PER_WIDTH * missing) ** 2 if at_edge and min(missing, evenly) > least else 0.0


@kernel
def _static_width(width, usual, displacement):
    """Return the width of a line less what its ``displacement`` while it is lit may add.

    Rows that it leaves or reaches widen it by the displacement, hence its standard deviation by up
    to that over the square root of 12.
    """
    return min(width, max(usual, width - displacement / ROOT_12))


@kernel(_nrt=False)
def _displacement(row, last_row, column):
    """Return how far the line has moved in a column since the last profile; 0 if not known."""
    c = np.uintp(column)
    displacement = abs(row[c] - last_row[c])
    return 0.0 if np.isnan(displacement) else displacement


@kernel(_nrt=False)
def _without_motion(smoothed, row, last_row, usual, lit_share, static_width):
    """Set widths less what the displacement of their lines since the last profile adds.

    A line is lit for ``lit_share`` of the time between two profiles. A jump confined to a few
    columns (a glint) is not motion: the displacement is limited to that of the columns beside.
    """
    beside, last = np.intp(_BESIDE), np.intp(row.size - 1)
    for c in range(np.intp(row.size)):
        before, after = max(c - beside, np.intp(0)), min(c + beside, last)
        near = max(_displacement(row, last_row, before), _displacement(row, last_row, after))
        displacement = min(_displacement(row, last_row, c), near)
        static_width[c] = _static_width(smoothed[c], usual, lit_share * displacement)


@kernel(_nrt=False)
def _follow_line(rows, smoothing, widths, history, lit_share, windowed):
    """Take motion off the widths of a profile's points, and compare it with recent profiles.

    Weak points show no width. Rows that are not ``windowed``, over full columns, are not compared:
    their widths are those of background.
    """
    row, static_width, typical = smoothing.row, widths.static_width, widths.usual.typical
    now = history.now
    returns, columns = row.shape
    known = _is_known(widths)
    usual = typical.median if known else np.inf
    sigma = _SIGMA_PER_MEDIAN * typical.difference
    _follow_widths(row[0], widths.last_row[0], smoothing.width[0], sigma, widths.trend)
    for k in range(returns):
        _without_motion(
            smoothing.width[k], row[k], widths.last_row[k], usual, lit_share, static_width[k]
        )
    for block in range(1, now.points.size - 1):
        total, width, sigma2, points, moved, in_both = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for c in range(
            np.uintp((block - 1) * BLOCK_COLUMNS), np.uintp(min(block * BLOCK_COLUMNS, columns))
        ):
            weak = rows.truncated[0, c] | (rows.events[0, c] < smoothing.isolation_events)
            if not (weak | np.isnan(row[0, c])):
                total += row[0, c]
                width += static_width[0, c]
                sigma2 += rows.sigma2[0, c]
                points += 1.0
                difference = row[0, c] - widths.last_row[0, c]
                if not np.isnan(difference):
                    moved += difference
                    in_both += 1.0
        now.row[block], now.width[block] = total, width
        now.sigma2[block], now.points[block] = sigma2, points
        now.moved[block], now.in_both[block] = moved, in_both
    if windowed:
        _compare_with_recent(history, known, typical.median, WIDTH_COLUMNS * sigma * sigma)


@kernel
def _moved_median(median, value, values):
    """Return the running median, moved towards ``value``, the last of this many ``values``."""
    step = max(1.0 / values, _STEP)
    if median == 0.0:
        return (1.0 - step) * value
    # Both products, so that each column waits less for the one before.
    above, below = (1.0 + step) * median, (1.0 - step) * median
    return above if value > median else below


@kernel
def _changed_variance(widths, known, k, c, row, sigma_width):
    """Return the variance of a ``row`` whose line has changed its width at an edge, px squared.

    An edge leaves one end of the line where it is, so that the row moves with the width: since it
    was steady or, where it has not been so yet, since the last profile. Half of that, to twice,
    counts, as rows and widths are smoothed differently. Else the variance is 0.
    """
    width, usual = widths.static_width[k, c], widths.usual.typical.mode
    same_width, same = widths.same_width, widths.same
    moved = abs(row - widths.last_row[k, c])
    if moved > width:
        # Another surface.
        same_width[k, c] = np.nan
    same_width[k, c], same[k, c] = _same_for(width, same_width[k, c], same[k, c], sigma_width)
    if same[k, c] > STEADY_PROFILES:
        widths.steady[k, c], widths.steady_row[k, c] = same_width[k, c], row
        return 0.0
    if not known or abs(width - usual) <= STEADY * sigma_width:
        return 0.0
    before = widths.steady[k, c]
    if not np.isnan(before):
        change = PER_WIDTH * abs(width - before)
        return change * change if abs(row - widths.steady_row[k, c]) > 0.5 * change else 0.0
    change = PER_WIDTH * abs(width - widths.last[k, c])
    at_edge = change > PER_WIDTH * sigma_width and 0.5 * change < moved < 2.0 * change
    return (PER_WIDTH * (width - usual)) ** 2 if at_edge else 0.0


@kernel(_nrt=False)
def _slow_edge_variance(widths, k, c, row, sigma_width, moves):
    """Return the variance of a ``row`` that an edge crosses in many profiles, px squared, else 0.

    Such a row ``moves`` by no more than it scatters from one to the next, but with the width since
    recent ones: half of what the width explains, to twice, counts. The means of recent widths and
    rows, which follow both alike, are brought up to date.
    """
    width, mode = widths.static_width[k, c], widths.usual.typical.mode
    wider, moved = width - widths.recent[k, c], row - widths.recent_row[k, c]
    if not abs(moved) < width:
        # Another surface.
        widths.recent[k, c], widths.recent_row[k, c] = width, row
        return 0.0
    widths.recent[k, c] += wider / RECENT_PROFILES
    widths.recent_row[k, c] += moved / RECENT_PROFILES
    unlike = min(abs(wider), mode - width) > STEADY * sigma_width
    if moves or not unlike:
        return 0.0
    share2 = moved * moved / (PER_WIDTH * wider) ** 2
    return (PER_WIDTH * (width - mode)) ** 2 if 0.25 < share2 < 4.0 else 0.0


@kernel
def _passing_variance(widths, passing2, k, c, sigma_width):
    """Return the variance of a row near an edge that passes its block of columns, px squared.

    ``passing2`` is that of the block. The row's line has, within its scatter, the usual and its
    steady width.
    """
    if passing2 == 0.0:
        return 0.0
    width, steady = widths.static_width[k, c], widths.steady[k, c]
    apart = abs(width - widths.usual.typical.median)
    if not np.isnan(steady):
        apart = max(apart, abs(width - steady))
    return min(passing2, PER_WIDTH**2 * (apart * apart + sigma_width * sigma_width))


@kernel(_nrt=False)
def _edge_and_weight(rows, smoothing, widths, k, c, sigma, reach, moves):
    """Return the variance of a row at an edge, px squared, and the weight of its line's width.

    ``sigma`` is the standard deviation of widths, px, ``reach`` the same in bins. A row ``moves``
    that has changed since the last profile by more than it scatters.
    """
    known, width = _is_known(widths), widths.static_width[k, c]
    edge2 = _changed_variance(widths, known, k, c, smoothing.row[k, c], sigma)
    slow2 = _slow_edge_variance(widths, k, c, smoothing.row[k, c], sigma, moves)
    if not known:
        return edge2, 1.0
    even = k == 0 and widths.trend.even[c]
    edge2 = 0.0 if even else max(edge2, slow2)
    edge2 = max(edge2, _mixed_variance(rows, smoothing, k, c, np.sqrt(WIDTH_COLUMNS) * sigma))
    edge2 = max(edge2, _oblique_variance(smoothing, widths, k, c, sigma))
    if _is_usual(widths.below, width, reach):
        return edge2, 1.0
    weight = _MOVING_WEIGHT if moves else _MIXED_WEIGHT
    scaled, mode = widths.usual.scale[c] * width, widths.usual.typical.mode
    if even or _is_usual(widths.below, scaled, reach):
        return edge2, weight
    return max(edge2, min(_unusual_variance(width, mode), _unusual_variance(scaled, mode))), weight


@kernel(_nrt=False)
def _mark_unusual(rows, smoothing, widths, history, few, lit_share, windowed):
    """Widen the variance of points that move or pass an edge, and mark the mixed ones."""
    row, sigma2, smoothed = smoothing.row, smoothing.sigma2, smoothing.width
    _follow_line(rows, smoothing, widths, history, lit_share, windowed)
    returns, columns = row.shape
    last, last_row = widths.last, widths.last_row
    known = _is_known(widths)
    usual, difference = widths.usual.typical.median, widths.usual.typical.difference
    sigma = _SIGMA_PER_MEDIAN * difference
    bends = widths.below[_BINS] + 1.0
    averaged, reach = 0.0, np.int64(1)
    for k in range(returns):
        for c in range(columns):
            width, displacement = widths.static_width[k, c], row[k, c] - last_row[k, c]
            row2, limit2 = sigma2[k, c], _MARKED**2 * rows.sigma2[k, c]
            block = c // BLOCK_COLUMNS + 1
            sigma2[k, c] += history.moved2[block]
            rows.mixed[k, c] = False
            if np.isnan(width) or rows.truncated[k, c]:
                widths.same_width[k, c] = np.nan
                continue
            events = rows.events[k, c]
            if events < few:
                # The width of few events scatters by more than those of most lines.
                sigma_few = max(sigma, usual / np.sqrt(2.0 * WIDTH_COLUMNS * max(events, 1)))
                edge2 = _changed_variance(widths, known, k, c, row[k, c], sigma_few)
                rows.mixed[k, c] = edge2 > limit2
                sigma2[k, c] += edge2
                continue
            if smoothing.used[k, c] != averaged:
                averaged = smoothing.used[k, c]
                reach = _reach(averaged, sigma)
            moves = displacement * displacement > STEADY**2 * row2
            edge2, weight = _edge_and_weight(rows, smoothing, widths, k, c, sigma, reach, moves)
            if events < smoothing.isolation_events:
                # It shows no width that others have.
                widths.same_width[k, c] = np.nan
            elif not abs(width - last[k, c]) > STEADY * sigma:
                widths.usual.number[_width_bin(width)] += weight
            rows.mixed[k, c] = edge2 > limit2
            passing2 = _passing_variance(widths, history.passing2[block], k, c, sigma)
            sigma2[k, c] += max(edge2, passing2)
            if c >= 2 * APART:
                bend = smoothed[k, c] - 2.0 * smoothed[k, c - APART] + smoothed[k, c - 2 * APART]
                if not np.isnan(bend):
                    bends += 1.0
                    difference = _moved_median(difference, abs(bend), bends)
    for k in range(returns):
        for c in range(np.uintp(columns)):
            last[k, c], last_row[k, c] = widths.static_width[k, c], row[k, c]
    widths.usual.typical.difference = difference
    _update(widths, columns)
