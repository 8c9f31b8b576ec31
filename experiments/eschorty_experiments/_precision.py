"""float32 against float64 where numbers turn into ranges, positions and times."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.optics import RangeModel, load_calibration
from eschorty_ros.report.experiment import DataTable, Effort, Finding

SPEED_MM_S = 300.0
HOUR_S = 3600.0
LINE_ROW, LINE_SIGMA_PX, LINE_EVENTS = 700.0, 0.3, 200
"""A narrow line far down the sensor: the hard case of a one-pass variance."""

Kind = type[np.floating[Any]]
Task = Callable[[Kind], NDArray[Any]]


def precision_table(effort: Effort) -> DataTable:
    """Return the largest errors against extended precision and times per value of both types."""
    model = load_calibration("config_3").model()
    count = effort.choose(200_000, 20_000)
    rng = np.random.default_rng(effort.seed)
    rows = np.linspace(0.0, model.rows - 1.0, count)
    column = rng.integers(0, model.columns, count)
    seconds = rng.uniform(0.0, HOUR_S, count)
    lines = np.rint(rng.normal(LINE_ROW, LINE_SIGMA_PX, (count // LINE_EVENTS, LINE_EVENTS)))
    cases: list[tuple[str, str, Task]] = [
        ("range of a row (Eq. 2)", "mm", lambda kind: _range(model, rows.astype(kind), kind)),
        (
            "position along the line",
            "mm",
            lambda kind: _lateral(model, rows.astype(kind), column.astype(kind), kind),
        ),
        ("row, to range and back", "px", lambda kind: _round_trip(model, rows.astype(kind), kind)),
        ("mean row of a column", "px", lambda kind: lines.astype(kind).mean(axis=1, dtype=kind)),
        ("spread of a column, E[y^2] - E[y]^2", "px", lambda kind: _spread(lines.astype(kind))),
        (
            f"stage position after {HOUR_S:g} s at {SPEED_MM_S:g} mm/s",
            "mm",
            lambda kind: np.asarray(seconds.astype(kind) * kind(SPEED_MM_S)),
        ),
    ]
    return DataTable(
        ["quantity", "unit", "float32_error", "float64_error", "float32_ns", "float64_ns"],
        [[name, unit, *_compare(task)] for name, unit, task in cases],
    )


def precision_findings(table: DataTable) -> list[Finding]:
    """Return errors of ranges, where float32 suffices, and of spreads and times, where not."""
    at = {str(row[0]): [float(value) for value in row[2:4]] for row in table.rows}
    (ranges, spread, stage) = (
        next(errors for name, errors in at.items() if name.startswith(start))
        for start in ("range of", "spread", "stage")
    )
    return [
        Finding("float32: largest error of the range equation", ranges[0], high=2e-3, unit="mm"),
        Finding("float64: largest error of the range equation", ranges[1], high=1e-11, unit="mm"),
        Finding(
            "float32: largest error of a column's spread in one pass", spread[0], 0.1, unit="px"
        ),
        Finding("float64: the same", spread[1], high=1e-6, unit="px"),
        Finding("float32: stage position from seconds after an hour", stage[0], 0.02, unit="mm"),
        Finding("float64: stage position from seconds after an hour", stage[1], high=1e-6,
                unit="mm"),
    ]  # fmt: skip


def _compare(task: Task) -> list[float]:
    exact = task(np.longdouble)
    errors, spent_ns = [], []
    for kind in (np.float32, np.float64):
        task(kind)
        began = time.process_time_ns()
        values = task(kind)
        spent_ns.append((time.process_time_ns() - began) / values.size)
        errors.append(float(np.max(np.abs(values - exact))))
    return errors + spent_ns


def _range(model: RangeModel, row: NDArray[Any], kind: Kind) -> NDArray[Any]:
    return np.asarray(kind(model.product_mm_px) / (row + kind(model.b_prime_px)) - kind(model.b_mm))


def _lateral(
    model: RangeModel, row: NDArray[Any], column: NDArray[Any], kind: Kind
) -> NDArray[Any]:
    pitch = kind(model.pixel_um * 1e-3 / model.k_mm)
    depth = _range(model, row, kind) + kind(model.b_mm)
    return np.asarray((column - kind(model.principal_column)) * pitch * depth)


def _round_trip(model: RangeModel, row: NDArray[Any], kind: Kind) -> NDArray[Any]:
    depth = _range(model, row, kind) + kind(model.b_mm)
    return np.asarray(kind(model.product_mm_px) / depth - kind(model.b_prime_px))


def _spread(lines: NDArray[Any]) -> NDArray[Any]:
    mean = lines.mean(axis=1)
    return np.sqrt(np.maximum((lines * lines).mean(axis=1) - mean * mean, 0))
