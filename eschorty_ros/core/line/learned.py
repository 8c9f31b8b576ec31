"""The footprint of the line, learned from the stream, and the row of greatest likelihood.

The footprint is the probability that a pixel gives k events in a period, by its distance from the
line. It is counted over points found already, made symmetric, which fixes what the centre of the
line is, and smoothed over a quarter of a row. A row is the mean of its posterior, whose spread is
its standard deviation. Rows beyond the sensor's edge have no events and count for nothing, so a
line that the edge cuts has the same centre as any other.

Log-likelihoods are integers: their sums are exact and do not depend on the order of the events.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.kernel import kernel, record
from eschorty_ros.core.line.estimators import _mean
from eschorty_ros.core.line.footprint_symmetry import _PLACES, _centre, _is_asymmetric
from eschorty_ros.core.line.line_history import _mean_of_blocks
from eschorty_ros.core.line.scatter import _learned_variance, _median_difference
from eschorty_ros.core.line.window import FRACTION, ROW_MASK

# Counts that are separated; the last is that number or more.
_COUNTS = 12
# Candidates to either side of the first row.
_SIDE = 2 * _PLACES
# Before every row of a line on the sensor.
_NOT_SAMPLED = -(1 << 20)
_ROW, _TWO_ROWS, _THREE_ROWS = np.uintp(_PLACES) * np.arange(1, 4, dtype=np.uintp)
# Steps of a log-likelihood of one.
_LOG_ONE = 64
# The least log-likelihood of a row in steps, and the least of all rows, which fits 16 bits.
_LOG_MIN, _LOG_SUM_MIN = -512, -(1 << 15)
# One of this many columns is learned from in a profile.
_STRIDE = 4
# Columns after which the footprint is computed again. Rows found with an earlier footprint are less
# exact, so its counts are forgotten.
_COLUMNS_MIN = 512
# Computations after which that number doubles with each.
_ROUNDS = 3
_DOUBLINGS = 5
# Each averages a place with its neighbours, which all smooth over a quarter of a row.
_SMOOTHING_PASSES = 4
# A prior of this many pixels at each distance.
_PRIOR_PIXELS = 2.0
# A prior of this many pixels with each count.
_PRIOR_COUNT = 0.02
# Most moves of the candidates towards the greatest likelihood.
_MOVES_MAX = 24
# A row further from the smoothed one is no place to learn from.
_OFF_LINE_PX = 1.0
# Learned rows take twice the time of means. They pay where they scatter less than means of twice
# the events would.
_PAYS = np.sqrt(0.5)
# Of a line that moves by more from profile to profile the lag, which learned rows reduce, is more
# than what its rows scatter.
_FAST_PX = 0.5
# Squared median size of the second differences of normal rows of variance one.
_MEDIAN2 = 6.0 * 0.6745**2
# Profiles that show it: the median of a profile's differences is known to some percent.
_TRIALS = 2
# Shares of the posterior by the logarithm below the best; less counts as none.
_SHARES = np.exp(-np.arange(8 * _LOG_ONE) / _LOG_ONE)


class Footprint(NamedTuple):
    """Counts of pixels by their events and distance, and the logarithms of their shares.

    ``log[k]`` is relative to that of no event but for ``log[0]``; ``empty`` is the sum of
    ``log[0]`` over all rows, by the line's place in its row and on over all candidates.
    ``rows_seen`` holds the events of the sampled columns' rows from ``first_row`` on, which may be
    before the sensor's, and is `_NOT_SAMPLED` where there is none. ``trial`` is by how much the
    learned rows of a profile differ from means.

    ``state`` has the number of ``profiles``, of ``computations`` and of the ``columns`` counted
    since; ``all_cut`` is 1 where the last one is of lines that are all cut, whose centre may be so
    many places ``away``; ``asymmetric`` counts those of lines that are so, ``near_edge`` is 1 while
    the sensor's edge cuts a line, for which means need a footprint, too. ``trying`` is 1 in
    profiles of the trial, ``trials`` their number so far, ``scatter`` and ``scatter_learned`` the
    sums of how much their rows scatter, in millionths of a row. ``choice`` is what followed from
    it, one of the three below.
    """

    pixels: NDArray[np.float64]
    log: NDArray[np.int16]
    none: NDArray[np.int16]
    empty: NDArray[np.int16]
    likelihood: NDArray[np.int16]
    rows_seen: NDArray[np.uint8]
    first_row: NDArray[np.int64]
    trial: NDArray[np.float64]
    state: Any
    reach: int


UNDECIDED, LEARNED_ROWS, MEAN_ROWS = 0, 1, 2


def make_footprint(half_max: int, columns: int) -> Footprint:
    """Return a footprint to be learned, for windows of ``half_max`` and narrower."""
    reach = half_max // FRACTION + 2
    size = 2 * (_PLACES * reach + _SIDE) + 1
    footprint = Footprint(
        pixels=np.zeros((_COUNTS, size)),
        log=np.zeros((_COUNTS, size), np.int16),
        none=np.zeros(size, np.int16),
        empty=np.zeros(_PLACES + 2 * _SIDE, np.int16),
        likelihood=np.zeros(2 * _SIDE, np.int16),
        rows_seen=np.zeros((columns // _STRIDE + 1, 2 * reach + 1), np.uint8),
        first_row=np.full(columns // _STRIDE + 1, _NOT_SAMPLED),
        trial=np.zeros(columns),
        state=record(
            "profiles",
            "computations",
            "columns",
            "all_cut",
            "away",
            "asymmetric",
            "near_edge",
            "trying",
            "trials",
            "scatter",
            "scatter_learned",
            "choice",
        ),
        reach=reach,
    )
    footprint.state["choice"] = MEAN_ROWS
    return footprint


@kernel(_nrt=True)
def _restart_from(footprint, known):
    """Begin to learn again, with what is ``known`` of the footprint."""
    footprint.pixels[:] = 0.0
    footprint.log[:] = known.log
    footprint.none[:] = known.none
    footprint.empty[:] = known.empty
    footprint.first_row[:] = _NOT_SAMPLED
    state, before = footprint.state, known.state
    state.profiles = state.columns = state.near_edge = state.trying = state.trials = 0
    state.scatter = state.scatter_learned = 0
    state.computations = before.computations
    state.all_cut, state.away = before.all_cut, before.away
    state.choice = before.choice


@kernel(_nrt=False, forceinline=True)
def _count_rows(column, low, high, counts):
    """Count the events of rows low..high into ``counts``; return the first and last row of any."""
    first, last = high + 1, low - 1
    for i in range(np.uintp(column.start), np.uintp(column.start + column.events)):
        row = np.int64(column.packed[i] & ROW_MASK)
        if low <= row <= high:
            counts[np.uintp(row)] += 1
            first, last = min(first, row), max(last, row)
    return first, last


@kernel(_nrt=False, forceinline=True)
def _sample(column, c, row, sensor_rows, footprint, counts):
    """Keep the events by row of column ``c`` to learn from, when its turn has come.

    ``counts`` is zeroed scratch, one per row.
    """
    slot = c // _STRIDE
    if (c - footprint.state.profiles) % _STRIDE != 0:
        return
    begin = np.int64(np.rint(row)) - footprint.reach
    first, last = max(begin, 0), min(begin + 2 * footprint.reach, sensor_rows - 1)
    _count_rows(column, first, last, counts)
    footprint.first_row[slot] = begin
    for at in range(first, last + 1):
        footprint.rows_seen[slot, at - begin] = min(counts[at], _COUNTS - 1)
    counts[first : last + 1] = 0


@kernel
def _events_in(counts, row):
    """Return the index of a row's count of events."""
    return np.uintp(min(counts[np.uintp(row)], _COUNTS - 1))


@kernel(_nrt=False, forceinline=True)
def _log_likelihoods(footprint, place, low, high, counts, sensor_rows):
    """Fill the log-likelihoods of the places around ``place``; return the best one's offset."""
    likelihood, log, none, reach = (
        footprint.likelihood,
        footprint.log,
        footprint.none,
        footprint.reach,
    )
    # Read from the array, so that it is no compile-time constant: LLVM then vectorises the loops.
    middle, candidates = log.shape[1] // 2, np.uintp(likelihood.size)
    if place - _SIDE >= _PLACES * reach and place + _SIDE <= _PLACES * (sensor_rows - 1 - reach):
        begin = np.uintp((place - _SIDE) % _PLACES)
        for m in range(candidates):
            likelihood[m] = footprint.empty[begin + m]
    else:
        for m in range(2 * _SIDE):
            at = place - _SIDE + m
            total = np.int64(0)
            for row in range(
                max(at // _PLACES - reach, 0), min(at // _PLACES + reach + 2, sensor_rows)
            ):
                if abs(at - _PLACES * row) <= _PLACES * reach:
                    total += none[middle + at - _PLACES * row]
            likelihood[m] = total
    row = low
    while row <= high:
        begin = np.uintp(middle + place - _SIDE - _PLACES * row)
        if row + 3 > high:
            a = _events_in(counts, row)
            for m in range(candidates):
                likelihood[m] += log[a, begin + m]
            row += 1
            continue
        # Four at once: sums are read and written less often.
        a, b, c, d = (
            _events_in(counts, row), _events_in(counts, row + 1),
            _events_in(counts, row + 2), _events_in(counts, row + 3),
        )  # fmt: skip
        for m in range(candidates):
            near = log[a, begin + m] + log[b, begin - _ROW + m]
            far = log[c, begin - _TWO_ROWS + m] + log[d, begin - _THREE_ROWS + m]
            likelihood[m] += near + far
        row += 4
    peak = likelihood[np.uintp(0)]
    for m in range(candidates):
        peak = max(peak, likelihood[m])
    for m in range(_SIDE):
        if likelihood[_SIDE + m] == peak:
            return m
        if likelihood[_SIDE - m] == peak:
            return -m
    return -_SIDE


@kernel(_nrt=False, forceinline=True)
def _learned_row(column, row, sensor_rows, footprint, counts):
    """Return the row of a line near ``row`` and its variance; 0 and -1 before any is learned.

    ``counts`` is zeroed scratch, one per row.
    """
    if footprint.state.computations == 0:
        return 0.0, -1.0
    place = np.int64(np.rint(_PLACES * row))
    reach = footprint.reach
    centre = np.int64(np.rint(row))
    margin = reach + 2 * _MOVES_MAX
    span = max(centre - margin, 0), min(centre + margin, sensor_rows - 1)
    all_low, all_high = _count_rows(column, span[0], span[1], counts)
    for turn in range(_MOVES_MAX):
        low = max(-((_PLACES * reach - place) // _PLACES), all_low)
        high = min((place + _PLACES * reach) // _PLACES, all_high)
        best = _log_likelihoods(footprint, place, low, high, counts, sensor_rows)
        if abs(best) <= _SIDE - 2 or turn == _MOVES_MAX - 1:
            break
        place = np.int64(min(max(place + best, -_PLACES), _PLACES * sensor_rows))
    likelihood = footprint.likelihood
    peak = likelihood[_SIDE + best]
    total, first, second = 0.0, 0.0, 0.0
    for direction in (1, -1):
        m = best if direction > 0 else best - 1
        while -_SIDE <= m < _SIDE:
            below = np.int64(peak - likelihood[_SIDE + m])
            if below >= _SHARES.size:
                break
            share = _SHARES[below]
            total += share
            first += m * share
            second += m * m * share
            m += direction
    offset = first / total
    mean = (place + offset) / _PLACES
    variance = max(second / total - offset * offset, 0.0) / (_PLACES * _PLACES)
    counts[all_low : all_high + 1] = 0
    return mean, variance


@kernel(_nrt=False)
def _centre_error_px(footprint):
    """Return by how much the centre of lines that are all cut may be off, if it is known."""
    away = footprint.state.away
    return (away + 1) / _PLACES if away >= 0 else np.inf


@kernel
def _compute(footprint, whole, lit_displacement_px, limit):
    """Compute the logarithms from the counts of pixels, of ``whole`` lines or of cut ones.

    The lines move by ``lit_displacement_px`` while they are lit. Places further than ``limit`` from
    the centre are as that one.
    """
    pixels, log, none = footprint.pixels, footprint.log, footprint.none
    size = pixels.shape[1]
    shares = pixels + pixels[:, ::-1]
    if whole:
        footprint.state.asymmetric += _is_asymmetric(pixels, lit_displacement_px)
    else:
        middle = size // 2
        centre, footprint.state.away = _centre(pixels)
        for b in range(size):
            at, mirrored = centre + b - middle, centre - b + middle
            shares[:, b] = 0.0
            if 0 <= at < size:
                shares[:, b] += pixels[:, at]
            if 0 <= mirrored < size:
                shares[:, b] += pixels[:, mirrored]
    if shares.sum() == 0.0:
        return
    overall = shares.sum(axis=1) / shares.sum()
    for k in range(_COUNTS):
        for _ in range(_SMOOTHING_PASSES):
            before = shares[k].copy()
            for b in range(size):
                low, high = before[max(b - 1, 0)], before[min(b + 1, size - 1)]
                shares[k, b] = 0.5 * before[b] + 0.25 * (low + high)
        shares[k] += _PRIOR_PIXELS * overall[k] + _PRIOR_COUNT
    least = max(_LOG_MIN, _LOG_SUM_MIN // (2 * footprint.reach + 3) + 1)
    for b in range(size // 2 + 1):
        at = max(b, size // 2 - limit)
        total = shares[:, at].sum()
        for k in range(_COUNTS):
            share = max(np.rint(_LOG_ONE * np.log(shares[k, at] / total)), least)
            if k == 0:
                none[b] = share
            log[k, b] = share - none[b]
        log[:, size - 1 - b], none[size - 1 - b] = log[:, b], none[b]
    reach, middle = footprint.reach, size // 2
    for place in range(footprint.empty.size):
        total = np.int64(0)
        for row in range(-reach - 1, reach + 2):
            at = place % _PLACES - _PLACES * row
            if abs(at) <= _PLACES * reach:
                total += none[middle + at]
        footprint.empty[place] = total
    footprint.state.computations += 1


@kernel(_nrt=True)
def _learn(footprint, rows, smoothed, sensor_rows, lit_displacement_px, half):
    """Count the pixels of the columns kept, at their distances from the ``smoothed`` rows.

    Those within the windows' ``half`` width count: beyond may be another line, as a reflection.
    Columns in which the sensor's edge cuts the line count where few others are, alone and at the
    distances from their mean rows, which are all off by about as much. Lines move by
    ``lit_displacement_px`` while they are lit.
    """
    row, uncertain, truncated = rows.row[0], rows.uncertain[0], rows.truncated[0]
    state = footprint.state
    whole = 4 * np.count_nonzero(truncated) <= 3 * np.count_nonzero(np.isfinite(row))
    pixels = footprint.pixels
    middle = pixels.shape[1] // 2
    limit = min(_PLACES * half // FRACTION, middle)
    for slot in range(footprint.first_row.size):
        first_row = footprint.first_row[slot]
        footprint.first_row[slot] = _NOT_SAMPLED
        c = slot * _STRIDE + state.profiles % _STRIDE
        if first_row == _NOT_SAMPLED or c >= row.size or uncertain[c] or whole == truncated[c]:
            continue
        if not abs(smoothed[c] - row[c]) <= _OFF_LINE_PX:
            continue
        first = max(-first_row, 0)
        last = min(2 * footprint.reach, sensor_rows - 1 - first_row)
        line = smoothed[c]
        if not whole:
            line = _mean(rows.events[0, c], rows.windows.first[0, c], rows.windows.d[0, c])
        begin = middle + np.int64(np.rint(_PLACES * (first_row - line)))
        for at in range(np.uintp(first), np.uintp(last + 1)):
            place = begin + np.int64(_PLACES * at)
            if abs(place - middle) <= limit:
                pixels[footprint.rows_seen[slot, at], np.uintp(place)] += 1.0
        state.columns += 1
    state.profiles += 1
    doublings = min(max(state.computations - _ROUNDS, 0), _DOUBLINGS)
    if state.columns >= _COLUMNS_MIN << doublings:
        _compute(footprint, whole, lit_displacement_px, limit)
        state.all_cut = not whole
        # Distances from mean rows do not depend on the footprint.
        pixels *= 0.0 if whole else 0.5
        state.columns = 0
        state.trying = state.choice == UNDECIDED and state.computations >= _ROUNDS


@kernel(_nrt=True)
def _learned_scatter(learned, rows, used, history):
    """Return the `_median_difference` of ``learned`` rows with what near columns share.

    Smoothing leaves all of that: it counts as often as columns are ``used`` for a row.
    """
    shared2 = np.zeros(history.step_px.size)
    for block in range(1, shared2.size - 1):
        shared2[block] = _learned_variance(learned, rows, block, history.step_px[block])
    mean2 = _mean_of_blocks(shared2, history.now.points) * np.mean(used[~np.isnan(learned)])
    return np.sqrt(_median_difference(learned) ** 2 + _MEDIAN2 * mean2)


@kernel(_nrt=True)
def _choose(footprint, rows, used, history, is_last, always):
    """Choose between learned rows and the means of ``rows`` by those of some profiles with both.

    With ``always`` it is the learned rows. It is the means where no profile up to the one that
    ``is_last`` has shown learned rows. Of a line that moves fast, by its ``history``, learned rows
    also lag less, which scatter does not show. Returns true when a choice was made.
    """
    state = footprint.state
    if state.choice != UNDECIDED:
        return False
    if state.trying > 0:
        row = rows.row[0]
        means = _median_difference(row)
        if means < np.inf:
            learned = _learned_scatter(row + footprint.trial, rows, used, history)
            state.scatter += np.int64(1e6 * means)
            state.scatter_learned += np.int64(1e6 * min(learned, 1e6))
            state.trials += 1
        footprint.trial[:] = 0.0
    if is_last or state.trials == _TRIALS or (always and state.trying > 0):
        fast = _mean_of_blocks(history.step_px > _FAST_PX, history.now.points) > 0.5
        least = (1.0 if fast else _PAYS) * state.scatter
        pays = always or state.scatter_learned < least
        state.choice = LEARNED_ROWS if pays else MEAN_ROWS
        state.trying = 0
    return state.choice != UNDECIDED
