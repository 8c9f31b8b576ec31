"""Pictures of a calibration: curve, residuals, magnification, uncertainty."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.calibration import SIGMA_ROW_PX, WIDTH_BIAS, CalibrationReport
from eschorty_ros.core.optics import depth_of_field_mm
from eschorty_ros.report.figures import new_figure

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# More targets than _MANY are drawn small; at most _FEW rejected ones get a number.
_MANY, _FEW = 60, 6
SYMBOLS = {
    "k_mm": "k (mm)",
    "k_prime_px": "k' (px)",
    "b_mm": "b (mm)",
    "b_prime_px": "b' (px)",
    "b_prime_1_px": "b'1 (px)",
    "b_prime_2_px": "b'2 (px)",
    WIDTH_BIAS: "width bias (px)",
}
# Correlated parameters, the most informative pair first.
_PAIRS = (
    ("k_prime_px", "b_prime_px"),
    ("b_mm", "b_prime_px"),
    ("k_mm", "k_prime_px"),
    ("k_mm", WIDTH_BIAS),
    ("b_prime_1_px", "b_prime_2_px"),
)
_PANELS = 3
_CHI_SQUARE_95 = {1: 3.841, 2: 5.991}


def curve_figure(report: CalibrationReport) -> Figure:
    """Draw range over row with the targets, and the standard deviation of a range over row."""
    figure = new_figure(11.0, 4.6)
    curve, sigma = figure.subplots(1, 2)
    model, nominal = report.fit.model, report.nominal.model()
    rows = np.arange(float(model.rows))
    curve.plot(rows, nominal.range_mm(rows), "--", color="0.5", label="design")
    curve.plot(rows, model.range_mm(rows), color="C0", label="fitted")
    targets, used = report.targets, report.used
    size = _marker(report)
    curve.plot(targets.row[used], targets.range_mm[used], "o", color="C1", ms=size, label="used")
    if not used.all():
        curve.plot(
            targets.row[~used], targets.range_mm[~used], "x", color="C3", ms=size, label="rejected"
        )
    curve.set(xlabel="row (px)", ylabel="range (mm)", title="Fitted curve and targets")
    sigma.plot(rows, report.range_sigma_mm(rows), color="C0", label="calibration alone")
    sigma.plot(
        rows,
        report.range_sigma_mm(rows, SIGMA_ROW_PX),
        color="C2",
        label=f"with a centroid of {SIGMA_ROW_PX} px",
    )
    sigma.set(
        xlabel="row (px)", ylabel="sigma of range (mm)", title="Range uncertainty", ylim=(0.0, None)
    )
    first, last = targets.row[used].min(), targets.row[used].max()
    for axes in (curve, sigma):
        for low, high in ((0.0, first), (last, model.rows - 1.0)):
            axes.axvspan(low, high, color="0.9", lw=0, label="no targets" if low == 0.0 else None)
        axes.legend()
        axes.grid(alpha=0.3)
        axes.set_xlim(0.0, model.rows - 1.0)
    return figure


def residual_figure(report: CalibrationReport) -> Figure:
    """Draw residuals in rows with sigmas, and in mm against one row and the depth of field."""
    figure = new_figure(11.0, 4.6)
    in_rows, in_mm = figure.subplots(1, 2)
    targets, used, fit = report.targets, report.used, report.fit
    at, residual, alone = targets.range_mm, report.residual_px, report.leave_one_out_px
    order = np.argsort(at[used])
    band = 3.0 * fit.sigma_px[order]
    in_rows.fill_between(at[used][order], -band, band, color="0.9", label="± 3 sigma")
    size = _marker(report)
    in_rows.plot(at[used], residual[used], "o", color="C1", ms=size, label="used")
    if len(targets) <= _MANY:
        in_rows.plot(at[used], alone[used], "o", mfc="none", color="C0", ms=8, label="without it")
    limit = 1.3 * float(np.nanmax(np.abs([*band, *residual[used], *alone[used]])))
    _rejected(in_rows, at[~used], residual[~used], limit, size)
    in_rows.set(
        xlabel="range (mm)", ylabel="row residual (px)", title="In rows", ylim=(-limit, limit)
    )
    ranges = np.linspace(at.min(), at.max(), 200)
    step, focus = fit.model.range_per_row_mm(ranges), depth_of_field(report, ranges)
    for sign in (-1.0, 1.0):
        name = "± depth of field (Eq. 3)" if sign > 0.0 else None
        in_mm.plot(ranges, sign * focus, ":", color="C4", label=name)
        name = "± one row (Eq. 4)" if sign > 0.0 else None
        in_mm.plot(ranges, sign * step, "--", color="C2", label=name)
    in_mm.plot(at[used], report.residual_mm[used], "o", color="C1", ms=size, label="used")
    if not used.all():
        in_mm.plot(at[~used], report.residual_mm[~used], "x", color="C3", ms=size, label="rejected")
    in_mm.set_yscale("symlog", linthresh=5.0)
    in_mm.set(xlabel="range (mm)", ylabel="range residual (mm)", title="Against one row and focus")
    ticks = [-100, -10, -5, 0, 5, 10, 100]
    in_mm.set_yticks(ticks, [str(tick) for tick in ticks])
    in_mm.minorticks_off()
    for axes in (in_rows, in_mm):
        axes.legend(fontsize="small", ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.16))
        axes.grid(alpha=0.3)
    return figure


def depth_of_field(report: CalibrationReport, range_mm: Array) -> Array:
    """Return half the depth of field at these ranges, mm (Eq. 3)."""
    model, build = report.fit.model, report.nominal
    return depth_of_field_mm(
        model.k_mm / (range_mm + model.b_mm),
        build.f_number,
        build.theta_deg,
        build.theta_prime_deg,
        build.pixel_um,
    )


def magnification_figure(report: CalibrationReport) -> Figure:
    """Draw magnification over row with sizes and spacings, and the profile of k."""
    profile = report.profile
    figure = new_figure(11.0 if profile else 6.5, 4.6)
    axes = figure.add_subplot(1, 2 if profile else 1, 1)
    model, nominal, targets = report.fit.model, report.nominal.model(), report.targets
    pixel_mm = model.pixel_um * 1e-3
    for build, style, colour, name in (
        (nominal, "--", "0.5", "design"), (model, "-", "C0", "fitted"),
    ):  # fmt: skip
        ends = np.array([0.0, -build.b_prime_px])
        axes.plot(ends, build.magnification(ends), style, color=colour, label=name)
    bias = report.fit.width_bias_px
    sized = (
        (targets.width_px - bias, targets.size_mm, targets.sigma_width_px, "o", "C1", "sizes"),
        (targets.spacing_px, targets.spacing_mm, targets.sigma_spacing_px, "s", "C4", "spacings"),
    )
    for columns, true_mm, sigma, marker, colour, name in sized:
        known = report.used & np.isfinite(columns * true_mm)
        if known.any():
            scale = pixel_mm / true_mm[known]
            axes.errorbar(
                targets.row[known], columns[known] * scale, 3.0 * sigma[known] * scale, fmt=marker,
                color=colour, ms=_marker(report), lw=1, capsize=2, label=f"{name} ± 3 sigma",
            )  # fmt: skip
    axes.axvspan(model.rows - 0.5, 1.05 * -model.b_prime_px, color="0.93", label="off the sensor")
    axes.set(
        xlabel="row (px)", ylabel="magnification", title="Magnification line",
        xlim=(0.0, 1.05 * -model.b_prime_px), ylim=(0.0, None),
    )  # fmt: skip
    axes.legend()
    axes.grid(alpha=0.3)
    if profile:
        _profile(figure.add_subplot(1, 2, 2), report)
    return figure


def _profile(axes: Axes, report: CalibrationReport) -> None:
    profile = report.profile
    assert profile is not None
    limit = _CHI_SQUARE_95[1]
    axes.plot(
        profile.k_mm, profile.delta_chi_square, color="C0", label="profile, without its prior"
    )
    axes.axhline(limit, color="C3", ls="--", label="95 %")
    axes.axvline(report.fit.model.k_mm, color="C1", label="fitted")
    axes.axvline(report.nominal.object_scale_mm, color="0.5", ls="--", label="design")
    axes.set(
        xlabel="k (mm)", ylabel="chi-square above its minimum", title="k from the targets",
        ylim=(0.0, 4.0 * limit),
    )  # fmt: skip
    axes.legend(fontsize="small", loc="upper center")
    axes.grid(alpha=0.3)


def covariance_figure(report: CalibrationReport) -> Figure:
    """Draw ellipses that contain the truth with 39 and 95 %, pair by pair, with the design."""
    free = report.fit.free
    shown = [pair for pair in _PAIRS if set(pair) <= set(free)][:_PANELS]
    if not shown:
        figure = new_figure(4.5, 4.2)
        _interval(figure.subplots(), report, free[0])
        return figure
    figure = new_figure(max(4.0 * len(shown), 5.5), 4.5)
    panels = figure.subplots(1, len(shown), squeeze=False)[0]
    for axes, pair in zip(panels, shown, strict=True):
        _ellipses(axes, report, pair)
    named: dict[str, Artist] = {}
    for axes in panels:
        handles, labels = axes.get_legend_handles_labels()
        named |= dict(zip(labels, handles, strict=True))
    figure.legend(
        handles=list(named.values()), labels=list(named), loc="outside lower center",
        ncols=len(named),
    )  # fmt: skip
    return figure


def _ellipses(axes: Axes, report: CalibrationReport, pair: tuple[str, str]) -> None:
    fit = report.fit
    at = [fit.free.index(name) for name in pair]
    centre = np.array([fit.values[name] for name in pair])
    values, vectors = np.linalg.eigh(fit.covariance[np.ix_(at, at)])
    turn = np.linspace(0.0, 2.0 * math.pi, 200)
    circle = np.stack([np.cos(turn), np.sin(turn)])
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    for radius, style, name in ((1.0, "-", "39 %"), (math.sqrt(_CHI_SQUARE_95[2]), "--", "95 %")):
        line = centre[:, None] + radius * root @ circle
        axes.plot(line[0], line[1], style, color="C0", label=name)
    axes.plot(*centre, "o", color="C1", label="fitted")
    limits = axes.get_xlim(), axes.get_ylim()
    design = [0.0 if n == WIDTH_BIAS else getattr(report.nominal.model(), n) for n in pair]
    inside = all(low <= v <= high for v, (low, high) in zip(design, limits, strict=True))
    if inside:
        axes.plot(*design, "D", color="0.4", ms=5, label="design")
    outer = np.sqrt(np.diag(fit.covariance)[at])
    off = (np.array(design) - centre) / outer
    note = "" if inside else f"\ndesign {off[0]:+.1f}, {off[1]:+.1f} sigma away"
    correlation = fit.covariance[at[0], at[1]] / (outer[0] * outer[1])
    axes.set(xlabel=SYMBOLS[pair[0]], ylabel=SYMBOLS[pair[1]])
    axes.set_title(f"correlation {correlation:+.3f}{note}", fontsize="medium")
    axes.ticklabel_format(useOffset=False)
    axes.tick_params(axis="x", labelrotation=30)
    axes.grid(alpha=0.3)


def _interval(axes: Axes, report: CalibrationReport, name: str) -> None:
    """Draw the normal density of a single fitted parameter."""
    value, sigma = report.fit.values[name], math.sqrt(report.fit.covariance[0, 0])
    x = np.linspace(-4.0, 4.0, 200)
    axes.plot(value + sigma * x, np.exp(-0.5 * x * x), color="C0", label="fitted")
    axes.set(xlabel=SYMBOLS[name], ylabel="density (relative)", title="Uncertainty")
    axes.ticklabel_format(useOffset=False)
    axes.legend()
    axes.grid(alpha=0.3)


def _marker(report: CalibrationReport) -> float:
    """Return the marker size of a target, smaller where they would hide each other."""
    return 6.0 if len(report.targets) <= _MANY else 2.0


def _rejected(axes: Axes, at: Array, residual: Array, limit: float, size: float) -> None:
    """Draw crosses, those beyond the limits at the rim; few of them with their residual."""
    if not at.size:
        return
    axes.plot(at, np.clip(residual, -0.93 * limit, 0.93 * limit), "x", color="C3", ms=size,
              label="rejected")  # fmt: skip
    if at.size > _FEW:
        return
    for x, y in zip(at, residual, strict=True):
        if abs(y) > limit:
            axes.annotate(
                f"{y:+.1f}", (x, math.copysign(0.93 * limit, y)), (6, 0), color="C3",
                textcoords="offset points", fontsize="small", va="center",
            )  # fmt: skip
