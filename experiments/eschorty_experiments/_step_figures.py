"""Figures of the reflectance steps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.report.figures import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True, eq=False)
class Fits:
    """Logarithmic and linear fit of shift against contrast, and R² of each."""

    log: Array
    linear: Array
    r2_log: float
    r2_linear: float


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """Shift of the centroid towards the brighter side, px, with the step at the line's centre.

    ``raw`` and ``compensated`` have one entry per contrast; ``scatter`` is the standard deviation
    of single points of ``raw``, ``intensity`` the shift of the irradiance's own centroid.
    """

    frequency_hz: float
    contrast: Array
    raw: Array
    scatter: Array
    compensated: Array
    intensity: Array
    fits: Fits


@dataclass(frozen=True, slots=True, eq=False)
class Passage:
    """Mean shift towards the brighter side over the step's offset from the line's centre, rows."""

    frequency_hz: float
    offset_rows: Array
    raw: Array
    compensated: Array


def fit(contrast: Array, shift: Array) -> Fits:
    """Return the least-squares fits of ``a + b ln(contrast)`` and ``a + b contrast``."""
    log = np.polyfit(np.log(contrast), shift, 1)
    linear = np.polyfit(contrast, shift, 1)
    total = float(np.sum((shift - shift.mean()) ** 2))
    left = [
        float(np.sum((shift - np.polyval(found, x)) ** 2))
        for found, x in ((log, np.log(contrast)), (linear, contrast))
    ]
    return Fits(log, linear, 1.0 - left[0] / total, 1.0 - left[1] / total)


def step_figure(curves: list[Curve], passages: list[Passage]) -> Figure:
    """Draw the shift against contrast per frequency, and as a step passes through the line."""
    figure = new_figure(13.0, 4.4)
    axes = [figure.add_subplot(1, 3, k + 1) for k in range(3)]
    for place, curve in zip(axes[:2], curves, strict=True):
        _contrast(place, curve)
    highest = max(float((c.raw + c.scatter).max()) for c in curves)
    for place in axes[:2]:
        place.set_ylim(-1.1, 1.1 * highest)
    for passage, colour in zip(passages, ("tab:blue", "tab:orange"), strict=True):
        label = f"{passage.frequency_hz:g} Hz"
        axes[2].plot(passage.offset_rows, passage.raw, "o-", ms=3, color=colour, label=label)
        axes[2].plot(
            passage.offset_rows, passage.compensated, "x--", ms=4, color=colour,
            label=f"{label}, compensated",
        )  # fmt: skip
    axes[2].set(
        xlabel="step above the line's centre (rows)",
        ylabel="shift towards the brighter side (px)",
        title="Black to white, passing through the line",
    )
    axes[2].legend(fontsize=8)
    axes[2].grid(alpha=0.3)
    return figure


def _contrast(axes: Axes, curve: Curve) -> None:
    x = np.linspace(curve.contrast.min(), curve.contrast.max(), 200)
    axes.errorbar(
        curve.contrast, curve.raw, curve.scatter, fmt="o", ms=4, capsize=2, color="tab:blue",
        label="as measured",
    )  # fmt: skip
    axes.plot(x, np.polyval(curve.fits.log, np.log(x)), color="tab:blue", lw=1,
              label=f"logarithmic, R² {curve.fits.r2_log:.2f}")  # fmt: skip
    axes.plot(x, np.polyval(curve.fits.linear, x), "--", color="0.5", lw=1,
              label=f"linear, R² {curve.fits.r2_linear:.2f}")  # fmt: skip
    axes.plot(curve.contrast, curve.compensated, "s", ms=4, color="tab:green", label="compensated")
    axes.plot(curve.contrast, curve.intensity, "k:", label="centroid of the irradiance")
    axes.axhline(0.0, color="0.6", lw=0.8)
    axes.set(
        xlabel="contrast from black",
        ylabel="shift towards the brighter side (px)",
        title=f"Step at the line's centre, {curve.frequency_hz:g} Hz",
    )
    axes.legend(fontsize=8)
    axes.grid(alpha=0.3)


def reflectance_figure(
    truth: list[Array], measured: list[Array], frequencies_hz: tuple[float, ...]
) -> Figure:
    """Draw measured against true reflectance, one panel per frequency, logarithmic axes."""
    figure = new_figure(13.0, 4.4)
    for k, (true, found) in enumerate(zip(truth, measured, strict=True)):
        axes = figure.add_subplot(1, len(truth), k + 1)
        axes.loglog(true, found, ".", ms=3, alpha=0.4)
        limits = (0.045, 1.7)
        axes.plot(limits, limits, "k--", lw=1)
        axes.set(
            xlim=limits, ylim=limits, xlabel="true reflectance", ylabel="measured, white is 1",
            title=f"{frequencies_hz[k]:g} Hz",
        )  # fmt: skip
        axes.grid(alpha=0.3, which="both")
    return figure
