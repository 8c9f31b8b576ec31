"""Columns of independent events: a Gaussian footprint, a second one, uniform background."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.line import FWHM_PER_SIGMA, Centroids, estimate

ROWS = 720


@dataclass(frozen=True, slots=True)
class Drawn:
    """Columns with the same number of events each."""

    truth: NDArray[np.float64]
    """Row of the line, shape (columns,)."""
    rows: NDArray[np.int64]
    """Rows of the events, shape (columns, events)."""
    fwhm_px: float
    signal: float
    """Events of the line per column, in the mean."""

    @property
    def bound_px(self) -> float:
        """Cramer-Rao bound of the row; the rounding to rows adds a twelfth to the variance."""
        return float(np.sqrt((self.fwhm_px / FWHM_PER_SIGMA) ** 2 + 1 / 12) / np.sqrt(self.signal))

    def estimate(self, method: str, returns: str = "strongest") -> Centroids:
        """Return the rows by the package's estimator, given the line's width."""
        offsets = np.arange(len(self.rows) + 1) * self.rows.shape[1]
        return estimate(
            self.rows.ravel(), offsets, method, returns=returns, line_width_px=self.fwhm_px
        )


def draw(
    rng: np.random.Generator,
    columns: int,
    fwhm_px: float,
    events: int,
    background: float,
    *,
    second: float = 0.0,
    apart_px: float = 0.0,
    centre: float | None = None,
) -> Drawn:
    """Draw columns of ``events`` events.

    - ``events``: Of the line and its background, per column.
    - ``background``: Share of them that is uniform over the sensor.
    - ``second``: Events of a second line, as a multiple of the first's, in addition.
    - ``apart_px``: Distance of the second line, towards higher rows.
    - ``centre``: Row of every line, anywhere in 200 to 400 otherwise. Events off the sensor are
      drawn again.
    """
    truth = rng.uniform(200.0, 400.0, columns) if centre is None else np.full(columns, centre)
    sigma = fwhm_px / FWHM_PER_SIGMA
    rows = rng.normal(truth[:, None], sigma, (columns, events))
    while (off := (rows < -0.5) | (rows >= ROWS - 0.5)).any():
        where = np.nonzero(off)
        rows[where] = rng.normal(truth[where[0]], sigma)
    noise = rng.random((columns, events)) < background
    rows[noise] = rng.uniform(-0.5, ROWS - 0.5, int(noise.sum()))
    extra = round(second * events * (1.0 - background))
    beyond = rng.normal(truth[:, None] + apart_px, sigma, (columns, extra))
    rounded = np.clip(np.rint(np.hstack([rows, beyond])), 0, ROWS - 1).astype(np.int64)
    return Drawn(truth, rounded, fwhm_px, events * (1.0 - background))


def error_over_bound(drawn: Drawn, found: Centroids) -> float:
    """Return the 68 % quantile of the absolute error over the bound, a missing row as far off."""
    error = np.nan_to_num(np.abs(found.row - drawn.truth), nan=float(ROWS))
    return float(np.quantile(error, 0.6827)) / drawn.bound_px


def gross_share(drawn: Drawn, found: Centroids) -> float:
    """Return the share of columns whose row is off by more than 2 FWHM, or missing."""
    return float(np.mean(~(np.abs(found.row - drawn.truth) <= 2.0 * drawn.fwhm_px)))
