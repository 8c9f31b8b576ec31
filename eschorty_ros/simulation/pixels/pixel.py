"""The event pixels behind the laser line.

Per pixel: relative photocurrent ``I = I_bg + A rho g(y) w(t)`` with a Gaussian ``g`` over the
rows, a photoreceptor whose bandwidth grows with ``I``, a source follower, comparator noise, an
ON/OFF comparator with fixed mismatch, a refractory time during which its reference follows the
signal, leak and background activity, a latency with jitter. Times of threshold crossings are
solved in closed form.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.kernel import entry_kernel, kernel
from eschorty_ros.core.base.sort_keys import sort_keys
from eschorty_ros.core.evt3 import EventArrays
from eschorty_ros.simulation.pixels._passage import DECISION_US, noise_table
from eschorty_ros.simulation.pixels._pixel import (
    FULL,
    PIXEL_DTYPE,
    WAITS,
    Model,
    _key,
    _live,
    _look_up,
    _mix,
    _rebias,
    _uniform,
)
from eschorty_ros.simulation.pixels._prompt import passage_gaps, way_times
from eschorty_ros.simulation.pixels.parameters import PixelParameters

T_SHIFT = 22
"""Bits below the time in an event key: row (10), polarity (1), column (11)."""
COLUMNS_MAX, ROWS_MAX = 2048, 1024

_COLUMN_DTYPE = np.dtype(
    [
        ("lit_begin", "i8"),  # rows [begin, end) that the line lights
        ("lit_end", "i8"),
        ("due_begin", "i8"),  # rows [begin, end) that have something due
        ("due_end", "i8"),
        ("due_us", "f8"),  # the earliest time of it
    ]
)
_PROCESS_DTYPE = np.dtype([("next_us", "f8"), ("count", "i8")])


class _Sensor(NamedTuple):
    """``light`` is room for the light on the rows of one column."""

    pixels: NDArray[np.void]
    columns: NDArray[np.void]
    light: NDArray[np.float64]


class _Optics(NamedTuple):
    """Least contrast drawn, light without the laser."""

    least_contrast: float
    background: float


class _Line(NamedTuple):
    """Patches of the line (n, patches, 5): row, contrast, rows between which it is lit, width."""

    columns: NDArray[np.int64]
    patches: NDArray[np.float64]


class _Background(NamedTuple):
    """Poisson events over the sensor: their rate, and the shares of OFF and of hot pixels."""

    per_us: float
    off_share: float
    hot_share: float
    hot: NDArray[np.int64]
    columns: int
    rows: int
    seed: np.uint64


class PixelArray:
    """All pixels of a sensor and their events that have not been taken.

    Same seed, same events, for any spacing of the calls to :meth:`run_until`. Memory is 64 bytes
    per pixel; unlit pixels cost no time.

    - ``columns``, ``rows``: Sensor size, at most 2048 x 1024.
    - ``background_hz``: Background activity per pixel.
    """

    def __init__(
        self,
        columns: int,
        rows: int,
        parameters: PixelParameters,
        seed: int = 0,
        background_hz: float = 0.0,
    ) -> None:
        if not (0 < columns <= COLUMNS_MAX and 0 < rows <= ROWS_MAX):
            raise ArgumentError(
                f"the sensor is {columns} x {rows}; choose at most {COLUMNS_MAX} x {ROWS_MAX}"
            )
        if not (math.isfinite(background_hz) and background_hz >= 0.0):
            raise ArgumentError(f"background_hz is {background_hz!r}; choose 0 or more")
        self.columns, self.rows = columns, rows
        self._background_hz = background_hz
        draws, kernel_seeds, hot_seed = np.random.SeedSequence(seed).spawn(3)
        self._draws = draws
        self._seeds = kernel_seeds.generate_state(2, np.uint64)
        self._hot = np.flatnonzero(
            np.random.default_rng(hot_seed).random(columns * rows) < parameters.hot_fraction
        )
        self._pixels = _at_rest((columns, rows), parameters.background_intensity)
        self._columns = np.zeros(columns, dtype=_COLUMN_DTYPE)
        self._columns["due_us"] = np.inf
        self._sensor = _Sensor(self._pixels, self._columns, np.empty(rows))
        # The next background event, and how many there have been.
        self._process = np.zeros(1, dtype=_PROCESS_DTYPE).view(np.recarray)[0]
        self._use(parameters)
        first = np.random.default_rng(self._seeds).exponential()
        rate = self._background.per_us
        self._process.next_us = first / rate if rate else np.inf
        self._keys = np.empty(1 << 16, dtype=np.int64)
        self._count = 0

    def change(self, t_us: int, parameters: PixelParameters) -> None:
        """Use ``parameters`` from ``t_us`` on, which must not fall from call to call.

        The light is kept until the next :meth:`relight`, hot pixels stay the same. A threshold
        that falls below the present signal of a pixel causes an event at once.
        """
        self.run_until(t_us)
        before, rate_before = self._model, self._background.per_us
        self._use(parameters)
        _rebias_columns(self._sensor, float(t_us), before, self._model)
        rate = self._background.per_us
        if rate != rate_before:
            # A Poisson process has no memory: the rest of the interval is scaled to the new rate.
            left = (self._process.next_us - t_us) * rate_before if rate_before else 1.0
            self._process.next_us = t_us + left / rate if rate else np.inf

    def _use(self, p: PixelParameters) -> None:
        self.parameters = p
        self._optics = _Optics(p.least_contrast, p.background_intensity)
        correlation_us = max(p.follower_us, DECISION_US)
        risks = noise_table(correlation_us)
        self._model = Model(
            p.omega_per_us,
            p.follower_us,
            float(p.noise),
            float(p.refractory_us),
            float(p.refractory_jitter),
            float(p.latency_us),
            float(p.latency_jitter_us),
            self._seeds[0],
            risks,
            way_times(),
            passage_gaps(risks, correlation_us),
        )
        self._draw_thresholds()
        # Leaks of unlit pixels are at random times, too: each has its own phase and rate.
        hot_hz = p.hot_hz * self._hot.size
        both_hz = self._background_hz * self.columns * self.rows + hot_hz
        total_hz = both_hz + p.leak_hz * self.columns * self.rows
        self._background = _Background(
            total_hz * 1e-6,
            0.5 * both_hz / total_hz if total_hz else 0.0,
            hot_hz / total_hz if total_hz else 0.0,
            self._hot,
            self.columns,
            self.rows,
            self._seeds[1],
        )

    def relight(
        self,
        t_us: int,
        columns: NDArray[np.int64],
        line_row: NDArray[np.float64],
        reflectance: NDArray[np.float64],
        low_row: NDArray[np.float64] | None = None,
        high_row: NDArray[np.float64] | None = None,
        sigma_rows: NDArray[np.float64] | None = None,
    ) -> None:
        """Place the line at ``line_row`` (rows) in ``columns`` from ``t_us`` on.

        - ``t_us``: Must not fall from call to call.
        - ``columns``: Shape (n,).
        - ``line_row``, ``reflectance``: Shape (n,) or (n, patches), as all that follow. A row that
          is NaN or a reflectance of 0 leaves the column unlit. With several patches the line
          has parts on different surfaces.
        - ``low_row``, ``high_row``: Rows between which a patch is lit (edges between rows, so
          ``y - 0.5`` to ``y + 0.5`` is one row); the complete line when left out.
        - ``sigma_rows``: Gaussian width of each patch, that of the parameters when left out.

        Raises ``ArgumentError`` for a reflectance outside 0 to 1.
        """
        if reflectance.size and not (reflectance.min() >= 0.0 and reflectance.max() <= 1.0):
            raise ArgumentError(
                f"reflectance reaches {reflectance.min()} to {reflectance.max()}; choose 0 to 1"
            )
        patches = np.empty((columns.size, 1 if line_row.ndim == 1 else line_row.shape[1], 5))
        for k, (values, otherwise) in enumerate(
            (
                (line_row, 0.0),
                (reflectance, 0.0),
                (low_row, -np.inf),
                (high_row, np.inf),
                (sigma_rows, self.parameters.sigma_rows),
            )
        ):
            patches[:, :, k] = otherwise if values is None else values.reshape(patches.shape[:2])
        patches[:, :, 1] *= self.parameters.amplitude
        line = _Line(columns, patches)
        begin = 0
        while begin < columns.size:
            begin, self._count = _relight(
                self._sensor, line, begin, self._optics, self._model, float(t_us),
                self._keys, self._count,
            )  # fmt: skip
            if begin < columns.size:
                self._grow()

    def run_until(self, t_us: int) -> None:
        """Process the pixels and the background activity up to ``t_us``."""
        begin = 0
        while begin < self.columns:
            begin, self._count = _run_columns(
                self._sensor, begin, float(t_us), self._model, self._keys, self._count
            )
            if begin < self.columns:
                self._grow()
        while True:
            self._count = _add_background(
                self._process, self._background, float(t_us), self._keys, self._count
            )
            if self._process.next_us > t_us:
                return
            self._grow()

    def take(self, before_us: int) -> NDArray[np.int64]:
        """Return the keys of the events requested before ``before_us``, sorted, without repeats.

        ``key >> T_SHIFT`` is the time, then follow row, polarity and column (:func:`unpack`).
        Call :meth:`run_until` with the same time first.
        """
        keys = self._keys[: self._count]
        ready = keys < (before_us << T_SHIFT)
        taken = keys[ready]
        left = keys[~ready]
        self._keys[: left.size] = left
        self._count = left.size
        sort_keys(taken)
        # np.unique hashes and is ten times slower here.
        return taken[np.append(True, taken[1:] != taken[:-1])[: taken.size]]

    def _grow(self) -> None:
        self._keys = np.concatenate((self._keys, np.empty_like(self._keys)))

    def _draw_thresholds(self) -> None:
        """Set the thresholds of every pixel; its mismatch is always the same."""
        p = self.parameters
        rng = np.random.default_rng(self._draws)
        for name, threshold, sign in (
            ("on_factor", p.threshold_on, -1.0),
            ("off_factor", p.threshold_off, 1.0),
        ):
            mismatch = rng.standard_normal(self._pixels.shape, dtype=np.float32)
            mismatch *= p.threshold_mismatch
            theta = np.maximum(threshold * (1.0 + mismatch), p.threshold_min)
            self._pixels[name] = np.exp(sign * theta)


def _at_rest(shape: tuple[int, int], background_intensity: float) -> NDArray[np.void]:
    """Return pixels at rest in the background light, without thresholds."""
    pixels = np.zeros(shape, dtype=PIXEL_DTYPE)
    for name in ("u", "y", "y_ref", "u_settled"):
        pixels[name] = 1.0 / background_intensity
    pixels["state"] = WAITS
    pixels["t_next"] = np.inf
    return pixels


def unpack(keys: NDArray[np.int64]) -> EventArrays:
    """Return the events of keys."""
    return EventArrays(
        keys >> T_SHIFT,
        (keys & 0x7FF).astype(np.uint16),
        ((keys >> 12) & 0x3FF).astype(np.uint16),
        ((keys >> 11) & 1).astype(np.uint8),
    )


@kernel
def _window(patch, optics, rows):
    """Return the rows [begin, end) in which a patch adds the least contrast; (0, 0) for none."""
    line_row, contrast, least = patch[0], patch[1], optics.least_contrast
    if not (contrast > least and abs(line_row) < 1e6):
        return 0, 0
    half = patch[4] * math.sqrt(2.0 * math.log(contrast / least))
    first = max(math.ceil(line_row - half), math.floor(max(patch[2] + 0.5, 0.0)))
    last = min(math.floor(line_row + half), math.ceil(min(patch[3] - 0.5, rows - 1.0)))
    begin = min(max(0, first), rows)
    return (begin, min(rows, last + 1)) if begin <= last else (0, 0)


@kernel
def _add_patch(light, begin, end, patch):
    """Add a patch of the line to ``light`` in rows [begin, end): a Gaussian by recurrence.

    A row that is lit in part gets its share.
    """
    offset, sigma = begin - patch[0], patch[4]
    value = patch[1] * math.exp(-0.5 * offset * offset / (sigma * sigma))
    ratio = math.exp(-(offset + 0.5) / (sigma * sigma))
    step_ratio = math.exp(-1.0 / (sigma * sigma))
    for row in range(begin, end):
        share = min(1.0, min(row + 0.5 - patch[2], patch[3] - row + 0.5))
        light[np.uintp(row)] += max(0.0, share) * value
        value *= ratio
        ratio *= step_ratio


@entry_kernel
def _relight(sensor, line, begin, optics, model, t_us, out, n):
    """Place the line in ``line.columns[begin:]`` from ``t_us`` on.

    Stops where the output does not suffice; returns the next column to do and the number of
    events.
    """
    pixels, light = sensor.pixels, sensor.light
    rows = pixels.shape[1]
    for k in range(begin, line.columns.size):
        column, patches = line.columns[k], line.patches[k]
        state = sensor.columns[column]
        lo, hi = rows, 0
        for j in range(patches.shape[0]):
            first, last = _window(patches[j], optics, rows)
            if last > first:
                lo, hi = min(lo, first), max(hi, last)
        old_lo, old_hi = state.lit_begin, state.lit_end
        if hi <= lo:
            lo, hi = old_lo, old_lo
        light[old_lo:old_hi] = optics.background
        light[lo:hi] = optics.background
        for j in range(patches.shape[0]):
            first, last = _window(patches[j], optics, rows)
            _add_patch(light, first, last, patches[j])
        # One run over both spans, unless they lie apart: what is between stays untouched.
        first, last = (min(lo, old_lo), max(hi, old_hi)) if hi > lo else (old_lo, old_hi)
        apart = hi < old_lo or lo > old_hi
        if old_hi <= old_lo:
            first, last, apart = lo, hi, False
        n, earliest = _live(
            pixels, column, old_lo if apart else first, old_hi if apart else last, t_us, light,
            model, out, n,
        )  # fmt: skip
        if apart and earliest != FULL:
            n, other = _live(pixels, column, lo, hi, t_us, light, model, out, n)
            earliest = min(earliest, other)
        if earliest == FULL:
            return k, n
        if model.noise > 0.0:
            _look_up(pixels, column, lo, hi, model)
            if apart or old_lo < lo or old_hi > hi:
                _look_up(pixels, column, old_lo, old_hi, model)
        if state.due_us == np.inf:
            state.due_begin, state.due_end = first, last
        else:
            state.due_begin = min(state.due_begin, first)
            state.due_end = max(state.due_end, last)
        state.due_us = min(state.due_us, earliest)
        state.lit_begin, state.lit_end = lo, hi
    return line.columns.size, n


@entry_kernel
def _run_columns(sensor, begin, until_us, model, out, n):
    """Process the pixels of the columns from ``begin`` on up to ``until_us``.

    Stops where the output does not suffice; returns the next column and the number of events.
    """
    pixels = sensor.pixels
    unchanged = np.empty(0)
    for column in range(begin, pixels.shape[0]):
        state = sensor.columns[column]
        if state.due_us > until_us:
            continue
        lo, hi = state.due_begin, state.due_end
        n, earliest = _live(pixels, column, lo, hi, until_us, unchanged, model, out, n)
        if earliest == FULL:
            return column, n
        # Rows with nothing due at both ends are left out: a line that moved on is not revisited.
        while lo < hi and pixels[np.uintp(column), np.uintp(lo)].t_next == np.inf:
            lo += 1
        while lo < hi and pixels[np.uintp(column), np.uintp(hi - 1)].t_next == np.inf:
            hi -= 1
        state.due_begin, state.due_end, state.due_us = lo, hi, earliest
    return pixels.shape[0], n


@entry_kernel
def _rebias_columns(sensor, t_us, before, after):
    for column in range(sensor.columns.size):
        state = sensor.columns[column]
        due = _rebias(sensor.pixels, column, t_us, before, after)
        state.due_begin, state.due_end, state.due_us = due.begin, due.end, due.earliest_us


@entry_kernel
def _add_background(process, background, until_us, out, n):
    """Add the background events up to ``until_us``; stop at a full output.

    Returns the number of events.
    """
    pixels = np.uint64(background.columns * background.rows)
    while process.next_us <= until_us and n < out.size:
        count = np.uint64(process.count)
        bits = _mix(background.seed ^ (np.uint64(2) * count))
        place = np.int64((bits >> np.uint64(24)) % pixels)
        polarity = np.int64(_uniform(_mix(bits)) >= background.off_share)
        draw = _mix(background.seed ^ (np.uint64(2) * count + np.uint64(1)))
        if background.hot.size and _uniform(_mix(draw)) < background.hot_share:
            place = background.hot[place % background.hot.size]
        column, row = place % background.columns, place // background.columns
        out[np.uintp(n)] = _key(process.next_us, column, row, polarity)
        n += 1
        process.next_us -= math.log(_uniform(draw)) / background.per_us
        process.count += 1
    return n
