"""The event pixels behind the laser line.

Per pixel: relative photocurrent ``I = I_bg + A rho g(y) w(t)`` with a Gaussian ``g`` over the
rows, a photoreceptor whose bandwidth grows with ``I``, a source follower, comparator noise, an
ON/OFF comparator with fixed mismatch, a refractory time during which its reference follows the
signal, leak and background activity, a latency with jitter. Times of threshold crossings are
solved in closed form.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.simulation.pixels._bias import _rebias
from eschorty_ros.simulation.pixels._noise_table import (
    DECISION_US,
    noise_table,
    passage_gaps,
    way_times,
)
from eschorty_ros.simulation.pixels._pixel import (
    PIXEL_DTYPE,
    WAITS,
    _background,
    _relight,
    _run_columns,
)
from eschorty_ros.simulation.pixels.parameters import PixelParameters

__all__ = ["PixelArray", "PixelParameters", "unpack"]

T_SHIFT = 22
"""Bits below the time in an event key: row (10), polarity (1), column (11)."""
COLUMNS_MAX, ROWS_MAX = 2048, 1024


class PixelArray:
    """All pixels of a sensor and the events they have made.

    Same seed, same events, however the calls to :meth:`run_until` are spaced. Memory is 64 bytes
    per pixel; dark pixels cost no time.

    Parameters
    ----------
    columns, rows : int
        Sensor size, at most 2048 x 1024.
    parameters : PixelParameters
    seed : int
    background_hz : float
        Background activity per pixel.
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
        self._spans = np.zeros((columns, 4), dtype=np.int64)
        self._due = np.full(columns, np.inf)
        self._light = np.empty(rows)
        # Time of the next background event, and how many there have been.
        self._process = np.array([np.inf, 0.0])
        self._use(parameters)
        if self._background_per_us:
            first = np.random.default_rng(self._seeds).exponential()
            self._process[0] = first / self._background_per_us
        self._keys = np.empty(1 << 16, dtype=np.int64)
        self._count = 0

    def change(self, t_us: int, parameters: PixelParameters) -> None:
        """Go on with what biases act on as in ``parameters`` from ``t_us`` on.

        Light stays as it is until the next :meth:`relight`, hot pixels stay those they are. A
        threshold that falls below what a pixel has already seen makes an event at once.

        Parameters
        ----------
        t_us : int
            Must not fall from call to call.
        parameters : PixelParameters
        """
        self.run_until(t_us)
        before, paced = self._model, self._background_per_us
        self._use(parameters)
        _rebias(self._pixels, self._spans, self._due, float(t_us), before, self._model)
        if self._background_per_us != paced:
            # Background has no memory: what is left of the wait goes on at the new rate.
            left = (self._process[0] - t_us) * paced if paced else 1.0
            now = self._background_per_us
            self._process[0] = t_us + left / now if now else np.inf

    def _use(self, p: PixelParameters) -> None:
        """Take over parameters, thresholds of every pixel among them."""
        self.parameters = p
        self._optics = np.array([p.sigma_rows, p.least_contrast, p.background_intensity])
        self._model = np.array(
            [
                p.omega_per_us,
                p.follower_us,
                p.noise,
                p.refractory_us,
                p.refractory_jitter,
                p.latency_us,
                p.latency_jitter_us,
            ]
        )
        correlation_us = max(p.follower_us, DECISION_US)
        risks = noise_table(correlation_us)
        self._tables = (risks, way_times(), passage_gaps(risks, correlation_us))
        self._draw_thresholds()
        # Leaks of dark pixels come at random times too: each has its own phase and rate.
        both_hz = self._background_hz * self.columns * self.rows + p.hot_hz * self._hot.size
        total_hz = both_hz + p.leak_hz * self.columns * self.rows
        self._background_per_us = total_hz * 1e-6
        self._shares = np.zeros(2)
        if total_hz:
            self._shares[:] = 0.5 * both_hz / total_hz, p.hot_hz * self._hot.size / total_hz

    def relight(
        self,
        t_us: int,
        columns: NDArray[np.int64],
        line_row: NDArray[np.float64],
        reflectance: NDArray[np.float64],
        low_row: NDArray[np.float64] | None = None,
        high_row: NDArray[np.float64] | None = None,
    ) -> None:
        """Put the line at ``line_row`` (rows) in ``columns`` from ``t_us`` on.

        Parameters
        ----------
        t_us : int
            Must not fall from call to call.
        columns : ndarray of int64, shape (n,)
        line_row, reflectance : ndarray of float64, shape (n,) or (n, patches)
            A row that is NaN or a reflectance of 0 leaves the column dark. With several patches
            the footprint is made of parts that lie on different surfaces.
        low_row, high_row : ndarray of float64, same shape, optional
            Rows between which a patch is lit (edges between rows, so ``y - 0.5`` to ``y + 0.5``
            is one row); the whole footprint when left out.

        Raises
        ------
        ArgumentError
            For a reflectance outside 0 to 1.
        """
        if reflectance.size and not (reflectance.min() >= 0.0 and reflectance.max() <= 1.0):
            raise ArgumentError(
                f"reflectance reaches {reflectance.min()} to {reflectance.max()}; choose 0 to 1"
            )
        patches = np.empty((columns.size, 1 if line_row.ndim == 1 else line_row.shape[1], 4))
        for k, (values, otherwise) in enumerate(
            ((line_row, 0.0), (reflectance, 0.0), (low_row, -np.inf), (high_row, np.inf))
        ):
            wanted = otherwise if values is None else values.reshape(patches.shape[:2])
            patches[:, :, k] = wanted
        patches[:, :, 1] *= self.parameters.amplitude
        begin = 0
        while True:
            begin, self._count = _relight(
                self._pixels,
                self._spans,
                self._due,
                columns,
                begin,
                patches,
                self._light,
                self._optics,
                self._model,
                self._tables,
                float(t_us),
                self._seeds[0],
                self._keys,
                self._count,
            )
            if begin == columns.size:
                return
            self._grow()

    def run_until(self, t_us: int) -> None:
        """Let the pixels and the background activity do what is due up to ``t_us``."""
        begin = 0
        while True:
            begin, self._count = _run_columns(
                self._pixels,
                self._spans,
                self._due,
                begin,
                float(t_us),
                self._model,
                self._tables,
                self._seeds[0],
                self._keys,
                self._count,
            )
            if begin == self.columns:
                break
            self._grow()
        while True:
            self._count = _background(
                self._process,
                self._background_per_us,
                self._shares,
                self._hot,
                float(t_us),
                self.columns,
                self.rows,
                self._seeds[1],
                self._keys,
                self._count,
            )
            if self._process[0] > t_us:
                return
            self._grow()

    def take(self, before_us: int) -> NDArray[np.int64]:
        """Keys of the events requested before ``before_us``, sorted, each pixel once per time.

        ``key >> T_SHIFT`` is the time, then follow row, polarity and column (:func:`unpack`).
        Call :meth:`run_until` with the same time first.
        """
        keys = self._keys[: self._count]
        ready = keys < (before_us << T_SHIFT)
        taken = keys[ready]
        left = keys[~ready]
        self._keys[: left.size] = left
        self._count = left.size
        taken.sort()
        if taken.size:
            fresh = np.empty(taken.size, dtype=bool)
            fresh[0] = True
            np.not_equal(taken[1:], taken[:-1], out=fresh[1:])
            taken = taken[fresh]
        return taken

    def _grow(self) -> None:
        self._keys = np.concatenate((self._keys, np.empty_like(self._keys)))

    def _draw_thresholds(self) -> None:
        """Give every pixel its thresholds; its mismatch is always the same."""
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
    """Pixels at rest in the background light, their thresholds still to be drawn."""
    pixels = np.zeros(shape, dtype=PIXEL_DTYPE)
    for name in ("u", "y", "y_ref", "u_settled"):
        pixels[name] = 1.0 / background_intensity
    pixels["state"] = WAITS
    pixels["t_next"] = np.inf
    return pixels


def unpack(
    keys: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.uint16], NDArray[np.uint16], NDArray[np.uint8]]:
    """Event keys as t (us), x, y, p."""
    return (
        keys >> T_SHIFT,
        (keys & 0x7FF).astype(np.uint16),
        ((keys >> 12) & 0x3FF).astype(np.uint16),
        ((keys >> 11) & 1).astype(np.uint8),
    )
