"""A calibration as one HTML page with its pictures inside."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from eschorty_ros.core.calibration import (
    COLUMN_TERMS,
    PARAMETERS,
    SIGMA_ROW_PX,
    WIDTH_BIAS,
    CalibrationReport,
)
from eschorty_ros.report import calibration_figures as drawn
from eschorty_ros.report.figures import DPI
from eschorty_ros.report.page import number, render
from eschorty_ros.report.sections import Picture, picture

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROWS_SHOWN = 9
_FIGURES: tuple[tuple[Callable[[CalibrationReport], Figure], str], ...] = (
    (
        drawn.curve_figure,
        "Left: range over row (Eq. 2), fitted and as designed, with the targets. Right: standard "
        "deviation of a range that the fit's own uncertainty causes, alone and with the centroid "
        "of one measurement. Grey areas have no targets: there the curve is extrapolated.",
    ),
    (
        drawn.residual_figure,
        "Left: residuals in rows, where the errors are, with three standard deviations; open "
        "circles (of up to 60 targets) are residuals against the fit without that target. Right: "
        "the same as ranges, against the step of one row (Eq. 4) and the depth of field (Eq. 3). "
        "The depth of field is no criterion: it is more than ten times too wide.",
    ),
    (
        drawn.magnification_figure,
        "Magnification over row (Eq. 1): a straight line that reaches 0 at row -b', where the "
        "range is infinite. Points are known sizes (less the width bias) and spacings; they alone "
        "separate k from k'. With k fitted, right: chi-square over fixed values of k.",
    ),
    (
        drawn.covariance_figure,
        "Uncertainty of the fitted parameters, pair by pair: ellipses that contain the truth with "
        "39 and 95 %. A thin slanted one means that only a combination of the two is determined.",
    ),
)


@dataclass(frozen=True, slots=True)
class Parameter:
    """A line of the table of parameters; ``sigma`` is NaN where it was not fitted."""

    name: str
    value: float
    sigma: float
    nominal: float
    prior: float
    ratio: float


def calibration_html(report: CalibrationReport, made_with: Mapping[str, str]) -> str:
    """Return the page, HTML that needs no other file.

    - ``made_with``: Facts for the head of the page, such as the source of the targets.
    """
    fit, name = report.fit, report.nominal.name
    return render(
        "calibration.html.jinja",
        title=f"Calibration of {name}",
        report=report,
        fit=fit,
        made_with=made_with,
        parameters=parameters(report),
        facts=_facts(report),
        pictures=[_picture(draw(report), caption) for draw, caption in _FIGURES],
        targets=_targets(report),
        sigmas=_sigmas(report),
    )


def parameters(report: CalibrationReport) -> list[Parameter]:
    """Return every parameter of the build; column terms and width bias only where fitted."""
    fit, nominal = report.fit, report.nominal.model()
    extra = [name for name in (*COLUMN_TERMS, WIDTH_BIAS) if name in fit.free]
    return [
        Parameter(
            name,
            fit.values[name],
            fit.sigmas.get(name, math.nan),
            float(getattr(nominal, name, 0.0)),
            fit.prior_sigma.get(name, math.nan),
            report.prior_ratio.get(name, math.nan),
        )
        for name in (*PARAMETERS, *extra)
    ]


def _facts(report: CalibrationReport) -> dict[str, str]:
    fit, calibration = report.fit, report.calibration
    used = int(report.used.sum())
    near, far = fit.model.range_limits_mm
    facts = {
        "targets": f"{used} used of {len(report.targets)}",
        "reduced chi-square": f"{number(fit.reduced_chi_square)} with {fit.dof} degrees of freedom",
        "residual, RMS": f"{number(calibration.residual_rms_px or 0.0)} px",
        "condition number": number(fit.condition_number),
        "ranges of the targets": "{:.0f} to {:.0f} mm".format(*(calibration.range_mm or (0, 0))),
        "ranges of the sensor": f"{near:.0f} to {far:.0f} mm",
    }
    if report.profile:
        low, high = report.profile.interval_mm
        facts["k from the targets, 95 %"] = f"{number(low)} to {number(high)} mm"
    return facts


def _picture(figure: Figure, caption: str) -> Picture:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=DPI)
    data = base64.b64encode(stream.getvalue()).decode()
    return picture(f"data:image/png;base64,{data}", figure, caption)


def _targets(report: CalibrationReport) -> list[list[float | str]]:
    """Return a line for each target: measured, residuals, and the reason if it was rejected."""
    targets, model = report.targets, report.fit.model
    reasons = {entry.index: entry.reason for entry in report.rejected}
    step = model.range_per_row_mm(targets.range_mm)
    focus = drawn.depth_of_field(report, targets.range_mm)
    columns = (
        targets.range_mm,
        targets.row,
        report.residual_px,
        report.leave_one_out_px,
        report.residual_mm,
        step,
        focus,
    )
    return [
        [targets.labels[i], *(float(column[i]) for column in columns), reasons.get(i, "used")]
        for i in range(len(targets))
    ]


def _sigmas(report: CalibrationReport) -> list[list[float]]:
    """Return lines of row, range, step of a row, sigma of the calibration, and with a centroid."""
    model = report.fit.model
    rows = np.linspace(0.0, model.rows - 1.0, ROWS_SHOWN)
    ranges = model.range_mm(rows)
    columns = (
        rows,
        ranges,
        model.range_per_row_mm(ranges),
        report.range_sigma_mm(rows),
        report.range_sigma_mm(rows, SIGMA_ROW_PX),
    )
    return np.column_stack(columns).tolist()
