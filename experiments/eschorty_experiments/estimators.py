"""Column estimators on independent events: error over the bound, gross errors, second returns."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from eschorty_experiments._drawn_columns import (
    ROWS,
    Drawn,
    draw,
    error_over_bound,
    gross_share,
)
from eschorty_experiments._estimator_figures import (
    WINDOWED,
    Case,
    Second,
    bounds_figure,
    returns_figure,
)
from eschorty_ros.core.base.progress import Progress
from eschorty_ros.core.line import FWHM_PER_SIGMA, METHODS, estimate
from eschorty_ros.report.experiment import (
    DataTable,
    Effort,
    Experiment,
    Finding,
    Outcome,
)

WIDTHS_PX = (2.0, 5.0, 10.0, 20.0)
EVENTS = (10, 30, 100, 200)
BACKGROUND = (0.0, 0.1, 0.3)
SECOND_EVENTS, SECOND_BACKGROUND, SECOND_FWHM_PX = 22, 0.1, 10.0
STRENGTHS = (0.0, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0)
APART_FWHM = (1.5, 1.75, 2.0, 2.25, 2.5, 3.0)
REPORTED_MIN = 30
CUT_FWHM_PX, CUT_EVENTS = 20.0, 100


def run(effort: Effort, progress: Progress) -> Outcome:
    """Draw columns of every kind and estimate their rows by every method."""
    rng = np.random.default_rng([effort.seed, 10])
    columns = effort.choose(40_000, 10_000)
    cases = _cases(rng, columns, progress)
    seconds = _seconds(rng, columns // 2)
    progress(0.8, "footprints cut by the sensor")
    cut = _cut(rng, columns // 4)
    mirror = _mirror_difference(rng, columns // 4)
    progress(0.9, "figures")
    return Outcome(
        findings=[
            *_bound_findings(cases),
            Finding("mirrored rows against the mirrored result, all methods", mirror, high=1e-12,
                    unit="px"),
            *_second_findings(seconds),
            *_cut_findings(cut),
        ],
        tables={
            "errors": _errors_table(cases),
            "all_errors": DataTable(
                ["method", "fwhm_px", "events", "background", "error_over_bound", "gross_share"],
                cases, shown=False,
            ),
            "second_returns": DataTable(
                ["method", "strength", "apart_fwhm", "strongest_error_over_bound",
                 "strongest_gross_share", "reported_share", "near_error_over_bound",
                 "far_error_over_bound"], seconds, shown=False,
            ),
            "beside_a_second": _beside_table(seconds),
            "cut_lines": DataTable(
                ["method", "row_px", "bias_over_sigma", "within_2_sigma"], cut
            ),
        },
        figures={"bounds": bounds_figure(cases), "returns": returns_figure(cases, seconds)},
        captions={
            "bounds": "68 % of the absolute error over the Cramer-Rao bound against events, width "
            "and background share. 1 is the least an unbiased estimator can reach.",
            "returns": "Left: share of columns with a gross error or no row. Middle and right: how "
            f"often a second line is reported; {SECOND_EVENTS} events in the first, "
            f"{SECOND_BACKGROUND:.0%} background, FWHM {SECOND_FWHM_PX:g} px; dotted: the least "
            "strength and distance of a second return.",
            "errors": "68 % of the absolute error over the bound, and in percent the columns with "
            "a gross error (beyond 2 FWHM) or no row",
            "all_errors": "The same for every width, number of events and background share",
            "beside_a_second": "Error of the strongest return over its bound beside a second line "
            "4 FWHM away, and in percent gross errors; strength of the second over the first",
            "second_returns": "Every second line: strongest return, share reported, both errors",
            "cut_lines": "Lines near the edge of the sensor: bias in standard deviations of the "
            "line, and share of errors within two reported sigma",
        },
        remarks=[
            "Events are independent and their number is fixed; those of a real pixel are "
            "correlated, which the reported sigma allows for and this bound does not.",
            "mean and median use the full column: background anywhere on the 720 rows moves the "
            "mean, which is the paper's method, by more than two widths.",
            "A second return needs half the strength of the first in its box, two widths of "
            "distance, and more events than background explains in any window of the column.",
        ],
    )  # fmt: skip


def _cases(rng: np.random.Generator, columns: int, progress: Progress) -> list[Case]:
    kinds = [(w, n, share) for w in WIDTHS_PX for n in EVENTS for share in BACKGROUND]
    cases = []
    for done, (width, events, share) in enumerate(kinds):
        progress(0.7 * done / len(kinds), f"{width:g} px, {events} events")
        drawn = draw(rng, columns, width, events, share)
        for method in METHODS:
            found = drawn.estimate(method)
            cases.append(
                Case(method, width, events, share, error_over_bound(drawn, found),
                     gross_share(drawn, found))
            )  # fmt: skip
    return cases


def _errors_table(cases: list[Case]) -> DataTable:
    rows: list[list[float]] = []
    for first in cases[:: len(METHODS)]:
        if first.background == 0.0 or first.events not in (10, 30, 200):
            continue
        kind = (first.fwhm_px, first.events, first.background)
        same = [case for case in cases if (case.fwhm_px, case.events, case.background) == kind]
        rows.append([*kind, *(round(value, 3) for case in same
                              for value in (case.over_bound, 100.0 * case.gross))])  # fmt: skip
    return DataTable(["fwhm_px", "events", "background", *_method_columns()], rows)


def _beside_table(seconds: list[Second]) -> DataTable:
    rows: list[list[float]] = []
    for strength in STRENGTHS[:-1]:
        same = [case for case in seconds if (case.strength, case.apart_fwhm) == (strength, 4.0)]
        rows.append([strength, *(round(value, 3) for case in same
                                 for value in (case.over_bound, 100.0 * case.gross))])  # fmt: skip
    return DataTable(["strength", *_method_columns()], rows)


def _method_columns() -> list[str]:
    return [name for method in METHODS for name in (method, f"{method}_gross_percent")]


def _seconds(rng: np.random.Generator, columns: int) -> list[Second]:
    kinds = [(strength, 4.0) for strength in STRENGTHS] + [(0.8, apart) for apart in APART_FWHM]
    seconds = []
    for strength, apart in kinds:
        drawn = draw(
            rng, columns, SECOND_FWHM_PX, SECOND_EVENTS, SECOND_BACKGROUND, second=strength,
            apart_px=apart * SECOND_FWHM_PX,
        )  # fmt: skip
        for method in METHODS:
            found = drawn.estimate(method)
            strongest = error_over_bound(drawn, found), gross_share(drawn, found)
            both = (np.nan, np.nan, np.nan)
            if method in WINDOWED:
                both = _both_returns(drawn, method, strength, apart * SECOND_FWHM_PX)
            seconds.append(Second(method, strength, apart, *strongest, *both))
    return seconds


def _both_returns(
    drawn: Drawn, method: str, strength: float, apart_px: float
) -> tuple[float, float, float]:
    """Return the share of columns with a second return, and both errors over their own bounds."""
    found = drawn.estimate(method, "all")
    both = np.isfinite(found.row[:, 1])
    if both.sum() < REPORTED_MIN:
        return float(both.mean()), np.nan, np.nan
    truth = drawn.truth[both, None] + [0.0, apart_px]
    error = np.quantile(np.abs(found.row[both] - truth), 0.6827, axis=0) / drawn.bound_px
    return float(both.mean()), float(error[0]), float(error[1]) * np.sqrt(strength)


def _cut(rng: np.random.Generator, columns: int) -> list[tuple[str, float, float, float]]:
    cut = []
    sigma = CUT_FWHM_PX / FWHM_PER_SIGMA
    for row in (0.0, 8.0, 16.0, ROWS - 1.0):
        drawn = draw(rng, columns, CUT_FWHM_PX, CUT_EVENTS, 0.0, centre=row)
        offsets = np.arange(columns + 1) * CUT_EVENTS
        for method in METHODS:
            # Independent events: their mean scatters by s/sqrt(N), hence a factor of 1.
            found = estimate(
                drawn.rows.ravel(),
                offsets,
                method,
                line_width_px=CUT_FWHM_PX,
                sigma_factor=1.0,
            )
            error = found.row - row
            within = float(np.mean(np.abs(error) < 2.0 * found.sigma_row))
            cut.append((method, row, float(np.mean(error)) / sigma, within))
    return cut


def _mirror_difference(rng: np.random.Generator, columns: int) -> float:
    worst = 0.0
    for width, events in ((5.0, 12), (20.0, 60)):
        drawn = draw(rng, columns, width, events, 0.3)
        mirrored = replace(drawn, rows=ROWS - 1 - drawn.rows)
        for method in METHODS:
            there, back = drawn.estimate(method).row, mirrored.estimate(method).row
            if (np.isnan(there) != np.isnan(back)).any():
                return np.inf
            worst = max(worst, float(np.nanmax(np.abs(there + back - (ROWS - 1)))))
    return worst


def _bound_findings(cases: list[Case]) -> list[Finding]:
    def worst(method: str, share: float) -> float:
        return max(
            case.over_bound for case in cases
            if case.method == method and case.background == share and case.events >= 30
        )  # fmt: skip

    def gross(method: str) -> float:
        return max(
            case.gross for case in cases
            if case.method == method and case.background == 0.3 and case.events == 10
        )  # fmt: skip

    return [
        *(Finding(f"mode_mean: error over the bound, N >= 30, {share:.0%} background, worst",
                  worst("mode_mean", share), high=1.1) for share in (0.1, 0.3)),
        *(Finding(f"{name}: gross errors or no row, N = 10, 30 % background, worst",
                  gross(name), high=0.015) for name in WINDOWED),
    ]  # fmt: skip


def _second_findings(seconds: list[Second]) -> list[Finding]:
    def clear(method: str) -> Second:
        return next(
            case for case in seconds
            if (case.method, case.strength, case.apart_fwhm) == (method, 0.8, 3.0)
        )  # fmt: skip

    # The windows are the same for every method, hence the returns.
    none = next(case for case in seconds if case.strength == 0.0)
    beside = next(case for case in seconds if case.strength == 0.2)
    return [
        Finding("second return where there is none", none.reported, high=1e-3),
        Finding("second return of 0.8 of the first, 3 FWHM apart, found",
                clear(WINDOWED[0]).reported, low=0.98),
        Finding("mode_mean: error of the strongest beside one of 0.2, over its bound",
                beside.over_bound, high=1.1),
        *(Finding(f"{name}: error of these two returns over their bounds",
                  max(clear(name).near_over_bound, clear(name).far_over_bound), high=1.1)
          for name in WINDOWED),
    ]  # fmt: skip


def _cut_findings(cut: list[tuple[str, float, float, float]]) -> list[Finding]:
    findings = []
    for name in METHODS:
        covered = min(case[3] for case in cut if case[0] == name)
        findings.append(
            Finding(f"{name}: cut lines within two reported sigma, worst", covered, low=0.95)
        )
    return findings


EXPERIMENT = Experiment("estimators", "Column estimators against the Cramer-Rao bound", run)
