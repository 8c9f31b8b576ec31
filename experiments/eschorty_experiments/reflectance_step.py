"""Fig. 7: shift of the centroid at reflectance steps, before and after compensation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from eschorty_experiments._crossing import Crossing, crossing
from eschorty_experiments._reflectance_bench import (
    FREQUENCIES_HZ as REFLECTANCE_HZ,
)
from eschorty_experiments._reflectance_bench import (
    Measured,
    measure_reflectance,
    summarise,
)
from eschorty_experiments._step_figures import (
    Curve,
    Passage,
    fit,
    reflectance_figure,
    step_figure,
)
from eschorty_ros.core.base.progress import Progress
from eschorty_ros.report.experiment import (
    DataTable,
    Effort,
    Experiment,
    Finding,
    Outcome,
)
from eschorty_ros.simulation.pixels import PixelParameters, preset

BLACK = 0.04
"""Reflectance of the black side; the paper's maximum corresponds to about this."""

CONTRASTS = (0.05, 0.1, 0.15, 0.25, 0.4, 0.55, 0.75, 1.0)
STEP_HZ = (70.0, 1000.0)
UNIFORM = (0.1, 0.4, 1.0)
# At 1 kHz a row gives half as many events per period.
ERROR_MAX = {70.0: 0.15, 300.0: 0.15, 1000.0: 0.2}
# Columns at either side of a group with another contrast in their neighbourhood.
_BORDER = 4
_BIN_ROWS = 2.0
# A step at the line's centre needs profiles in which it has left the line on either side.
_CENTRE_MARGIN_ROWS = 24.0
_SHOWN_ROWS = 14.0


def run(effort: Effort, progress: Progress) -> Outcome:
    """Simulate steps and uniform targets at 70 Hz and 1 kHz, with and without compensation."""
    parameters = preset("paper")
    curves, passages, uniform = [], [], []
    for k, frequency_hz in enumerate(STEP_HZ):
        progress(0.35 * k, f"steps at {frequency_hz:g} Hz")
        curves.append(_curve(parameters, frequency_hz, effort))
        passages.append(_passage(parameters, frequency_hz, effort))
        uniform += [_uniform(parameters, frequency_hz, rho, effort) for rho in UNIFORM]
    progress(0.7, "reflectance")
    measured = [measure_reflectance(parameters, f, effort) for f in REFLECTANCE_HZ]
    return Outcome(
        findings=[
            *_curve_findings(curves),
            *_passage_findings(passages),
            Finding("uniform targets: largest rms change by compensation",
                    max(row[2] for row in uniform), high=0.1, unit="px"),
            *_reflectance_findings(measured),
        ],
        tables={
            "shift": _shift_table(curves),
            "passage": _passage_table(passages),
            "uniform": DataTable(
                ("frequency_hz", "reflectance", "rms_change_px", "share_changed"), uniform
            ),
            "errors": DataTable(
                ("frequency_hz", "from", "to", "median_error", "scatter", "stated_sigma",
                 "within_1_sigma", "within_2_sigma"),
                [row for one in measured for row in summarise(one)],
            ),
        },
        figures={
            "steps": step_figure(curves, passages),
            "reflectance": reflectance_figure(
                [m.truth for m in measured], [m.reflectance for m in measured], REFLECTANCE_HZ
            ),
        },
        captions={
            "steps": "Left and middle: shift of the centroid with a step from black "
            f"({BLACK:g}) at the line's centre against the contrast from black; bars are the "
            "scatter of single points. Right: mean shift as the step passes through the line.",
            "reflectance": "Reflectance of single points against the truth; a white target is the "
            "reference.",
            "shift": "Shift at the line's centre",
            "passage": "Mean shift over the passage of a step from black to white",
            "uniform": "Change of uniform targets by compensation",
            "errors": "Relative error of the reflectance of single points",
        },
        remarks=_remarks(),
    )  # fmt: skip


def _remarks() -> list[str]:
    return [
        "The paper's linear extrapolation beyond 7.5 px, twice its largest shift, depends on its "
        "first two points alone; here both laws are fitted to all contrasts. It is not half of "
        "what a linear sensor has: the centroid of the same irradiance (dotted) moves less than "
        "that of the events, since the logarithm widens the footprint on either side.",
        "Compensation needs profiles before and behind the step: its delay is the number of "
        "profiles within the line's width, and the direction is that of the stage's motion. "
        "Without any lit column there is no profile, so a uniform board surrounds the target.",
        "A step off the line's centre causes a larger shift than one at it: where the black side "
        "has no events, only the bright part of the footprint is measured, up to half its width "
        "off.",
    ]


def _curve(parameters: PixelParameters, frequency_hz: float, effort: Effort) -> Curve:
    each = effort.choose(40, 20)
    contrast = np.array(CONTRASTS)
    after = np.repeat(BLACK + contrast * (1.0 - BLACK), each)
    case = crossing(parameters, frequency_hz, BLACK, after, columns=after.size, seed=effort.seed)
    middle = len(case.offset_rows) // 2
    group = np.arange(after.size) // each
    place = np.arange(after.size) % each
    inner = (place >= _BORDER) & (place < each - _BORDER)
    shifts = []
    for choice in ("off", "on"):
        period, column, shift = _shifts(case, choice)
        here = (period == middle) & inner[column]
        shifts.append([shift[here & (group[column] == k)] for k in range(contrast.size)])
    raw = np.array([part.mean() for part in shifts[0]])
    return Curve(
        frequency_hz,
        contrast,
        raw,
        np.array([part.std() for part in shifts[0]]),
        np.array([part.mean() for part in shifts[1]]),
        _intensity_shift(parameters, contrast),
        fit(contrast, raw),
    )


def _intensity_shift(
    parameters: PixelParameters, contrast: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the shift of the centroid of the line's irradiance, half of it on either side."""
    bright = BLACK + contrast * (1.0 - BLACK)
    half_mean = np.sqrt(2.0 / np.pi) * parameters.sigma_rows
    return np.asarray(half_mean * (bright - BLACK) / (bright + BLACK))


def _shifts(
    case: Crossing, compensation: str
) -> tuple[NDArray[np.int64], NDArray[np.intp], NDArray[np.float64]]:
    """Return period, column and shift towards the new surface of the target's points."""
    found, _ = case.reconstruct(reflectance_compensation=compensation, smoothing_half_width=0)
    column = found.column.astype(np.intp)
    target = case.target[column]
    shift = case.line_row[column] - found.row
    return found.period[target], column[target], shift[target]


def _passage(parameters: PixelParameters, frequency_hz: float, effort: Effort) -> Passage:
    case = crossing(
        parameters, frequency_hz, BLACK, 1.0, columns=effort.choose(160, 80), slanted=True,
        seed=effort.seed,
    )  # fmt: skip
    offset: list[float] = []
    means: list[list[float]] = [[], []]
    for k, choice in enumerate(("off", "on")):
        period, column, shift = _shifts(case, choice)
        place = np.rint(case.offset_rows[period, column] / _BIN_ROWS).astype(np.int64)
        shown = [j for j in np.unique(place) if abs(j * _BIN_ROWS) <= _SHOWN_ROWS]
        offset = [float(j * _BIN_ROWS) for j in shown]
        means[k] = [float(shift[place == j].mean()) for j in shown]
    return Passage(frequency_hz, np.array(offset), np.array(means[0]), np.array(means[1]))


def _uniform(
    parameters: PixelParameters, frequency_hz: float, reflectance: float, effort: Effort
) -> list[float]:
    case = crossing(
        parameters, frequency_hz, reflectance, reflectance, columns=effort.choose(120, 48),
        margin_rows=_CENTRE_MARGIN_ROWS, background_hz=0.2, seed=effort.seed,
    )  # fmt: skip
    off, _ = case.reconstruct(reflectance_compensation="off")
    on, counts = case.reconstruct(reflectance_compensation="on")
    change = float(np.sqrt(np.mean((on.row - off.row) ** 2)))
    return [frequency_hz, reflectance, change, counts["columns_compensated"] / len(on)]


def _curve_findings(curves: list[Curve]) -> list[Finding]:
    slow = curves[0]
    findings = [
        Finding("largest shift at 70 Hz", float(slow.raw.max()), 3.0, 4.5, "px"),
        Finding("largest shift at 70 Hz over that of the irradiance's centroid",
                float(slow.raw.max() / slow.intensity.max()), 1.0, 1.5),
        Finding("R² of the logarithmic fit at 70 Hz", slow.fits.r2_log, low=0.9),
        Finding("R² logarithmic above linear at 70 Hz",
                slow.fits.r2_log - slow.fits.r2_linear, low=0.0),
    ]  # fmt: skip
    for curve in curves:
        left = float(np.abs(curve.compensated).max() / curve.raw.max())
        findings.append(
            Finding(f"largest shift left after compensation over the largest before, "
                    f"{curve.frequency_hz:g} Hz", left, high=0.5)
        )  # fmt: skip
    return findings


def _passage_findings(passages: list[Passage]) -> list[Finding]:
    return [
        Finding(f"the same over the whole passage of a step, {passage.frequency_hz:g} Hz",
                float(np.abs(passage.compensated).max() / np.abs(passage.raw).max()), high=0.5)
        for passage in passages
    ]  # fmt: skip


def _reflectance_findings(measured: list[Measured]) -> list[Finding]:
    findings = []
    for one in measured:
        error, pull = one.error, np.abs(one.pull)
        name = f"reflectance 0.1 to 1 at {one.frequency_hz:g} Hz"
        usable = one.truth >= 0.1
        findings += [
            Finding(f"{name}: median size of the relative error",
                    float(np.median(np.abs(error[usable]))),
                    high=ERROR_MAX[one.frequency_hz]),
            Finding(f"{name}: within the stated sigma",
                    float(np.mean(pull[usable] < 1.0)), 0.6, 0.8),
        ]  # fmt: skip
    return findings


def _shift_table(curves: list[Curve]) -> DataTable:
    return DataTable(
        ("frequency_hz", "contrast", "shift_px", "scatter_px", "compensated_px", "intensity_px"),
        [
            [curve.frequency_hz, *(float(v) for v in row)]
            for curve in curves
            for row in zip(
                curve.contrast,
                curve.raw,
                curve.scatter,
                curve.compensated,
                curve.intensity,
                strict=True,
            )
        ],
    )


def _passage_table(passages: list[Passage]) -> DataTable:
    return DataTable(
        ("frequency_hz", "offset_rows", "shift_px", "compensated_px"),
        [
            [passage.frequency_hz, *(float(v) for v in row)]
            for passage in passages
            for row in zip(passage.offset_rows, passage.raw, passage.compensated, strict=True)
        ],
        shown=False,
    )


EXPERIMENT = Experiment("reflectance_step", "Reflectance steps and reflectance (Fig. 7)", run)
