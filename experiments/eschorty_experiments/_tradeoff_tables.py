"""Tables of the trade-off, and its Pareto front."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from eschorty_experiments._scan_errors import ScanErrors, pooled
from eschorty_experiments._tradeoff_runs import (
    BACKGROUND_SHARES,
    Measured,
    Variant,
    one_change,
)
from eschorty_ros.report.experiment import DataTable

TYPICAL = 0.05
"""Share of background at which speeds are compared."""


@dataclass(frozen=True, slots=True, eq=False)
class Summary:
    """A variant over all scenes at one background."""

    variant: Variant
    background_share: float
    ns_per_event: float
    us_per_profile: float
    peak_mb: float
    errors: ScanErrors


def summary(measured: Sequence[Measured], share: float) -> Summary:
    """Return the summary of the runs of one variant at one background."""
    chosen = [one for one in measured if one.stream.background_share == share]
    seconds = sum(one.seconds for one in chosen)
    peaks = [one.peak_bytes for one in measured if math.isfinite(one.peak_bytes)]
    return Summary(
        chosen[0].variant,
        share,
        seconds / sum(one.stream.events for one in chosen) * 1e9,
        seconds / sum(one.stream.periods for one in chosen) * 1e6,
        peaks[0] * 1e-6,
        pooled([one.errors for one in chosen]),
    )


def of(summaries: Sequence[Summary], variant: Variant) -> dict[float, Summary]:
    """Return the summaries of a variant by background."""
    return {one.background_share: one for one in summaries if one.variant == variant}


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return the indices of the points with no better one in both coordinates, by the first one."""
    front: list[int] = []
    best = math.inf
    for index in sorted(range(len(points)), key=lambda k: points[k]):
        if points[index][1] < best:
            front.append(index)
            best = points[index][1]
    return front


def changes_table(summaries: Sequence[Summary]) -> DataTable:
    """Return baseline, default, and the default with one setting changed: docs/tradeoff.md."""
    percent = [f"{100 * share:g}" for share in BACKGROUND_SHARES]
    columns = [
        "setting",
        "ns_per_event",
        "us_per_profile",
        "times_baseline_speed",
        "peak_MB",
        *(f"rmse_{p}_percent_mm" for p in percent),
        *(f"gross_{p}_percent" for p in percent),
        "completeness",
    ]
    rows: list[list[float | int | str]] = []
    base = of(summaries, Variant(None))
    for variant in one_change():
        parts = of(summaries, variant)
        typical = parts[TYPICAL]
        rows.append(
            [
                variant.label,
                typical.ns_per_event,
                typical.us_per_profile,
                base[TYPICAL].ns_per_event / typical.ns_per_event,
                typical.peak_mb,
                *(part.errors.rmse_mm for part in parts.values()),
                *(part.errors.gross_share for part in parts.values()),
                min(part.errors.completeness for part in parts.values()),
            ]
        )
    return DataTable(columns, rows)


def summary_table(summaries: Sequence[Summary]) -> DataTable:
    """Return every variant at every background."""
    fronts = {}
    for share in BACKGROUND_SHARES:
        at = [one for one in summaries if one.background_share == share]
        front = pareto_front([(one.ns_per_event, one.errors.rmse_mm) for one in at])
        fronts[share] = [at[k] for k in front]
    return DataTable(
        [
            "estimator",
            "filters",
            "smoothing_half_width",
            "default",
            "background_share",
            "ns_per_event",
            "us_per_profile",
            "peak_MB",
            "rmse_mm",
            "median_mm",
            "p95_mm",
            "gross_share",
            "completeness",
            "on_front",
        ],
        [
            [
                one.variant.estimator,
                one.variant.filters,
                one.variant.half_width,
                int(one.variant.is_default),
                one.background_share,
                one.ns_per_event,
                one.us_per_profile,
                one.peak_mb,
                one.errors.rmse_mm,
                one.errors.median_mm,
                one.errors.quantile_mm(0.95),
                one.errors.gross_share,
                one.errors.completeness,
                int(any(one is member for member in fronts[one.background_share])),
            ]
            for one in summaries
        ],
        shown=False,
    )


def runs_table(measured: Sequence[Measured]) -> DataTable:
    """Return every variant on every scene and background."""
    return DataTable(
        [
            "scene",
            "background_share",
            "estimator",
            "filters",
            "smoothing_half_width",
            "events",
            "profiles",
            "seconds",
            "ns_per_event",
            "us_per_profile",
            "points_compared",
            "rmse_mm",
            "median_mm",
            "gross_share",
            "completeness",
        ],
        [
            [
                one.stream.scene_name,
                one.stream.background_share,
                one.variant.estimator,
                one.variant.filters,
                one.variant.half_width,
                one.stream.events,
                one.stream.periods,
                one.seconds,
                one.seconds / one.stream.events * 1e9,
                one.seconds / one.stream.periods * 1e6,
                one.errors.error_mm.size,
                one.errors.rmse_mm,
                one.errors.median_mm,
                one.errors.gross_share,
                one.errors.completeness,
            ]
            for one in measured
        ],
        shown=False,
    )
