"""Static light beside the line: events against centroids of the same irradiance."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.base.progress import Progress
from eschorty_ros.core.line import estimate
from eschorty_ros.report.experiment import (
    DataTable,
    Effort,
    Experiment,
    Finding,
    Outcome,
)
from eschorty_ros.report.figures import new_figure
from eschorty_ros.simulation.pixels import PixelArray, preset, unpack

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROWS = 720
STRENGTHS = (0.0, 0.03, 0.1, 0.3, 1.0, 3.0)
"""Peak of the static light as a multiple of the line's."""
SOURCES = {"defocused, 30 rows": 30.0, "sharp, 4 rows": 4.1}
"""Width of the static light, standard deviation in rows."""
APART_ROWS = (15.0, 60.0)
FREQUENCY_HZ = 70.0
SETTLING = 2
"""Periods left out: the static light comes on with the first one."""
FULL_WELL, GREY_LEVELS = 10_000.0, 256
"""Electrons of the frame camera's brightest pixel, and its levels."""
METHODS = ("events", "intensity centroid", "frame camera")


class _Target(NamedTuple):
    """The line and a static source in every column: their rows, the source's strength and width."""

    line: Array
    source: Array
    strength: float
    sigma_rows: float


def run(effort: Effort, progress: Progress) -> Outcome:
    """Measure the same lines beside static light of several strengths by every method."""
    rng = np.random.default_rng([effort.seed, 13])
    columns, periods = effort.choose(512, 128), effort.choose(20, 8)
    line = rng.uniform(300.0, 301.0, columns)
    apart = rng.uniform(*APART_ROWS, columns) * rng.choice([-1.0, 1.0], columns)
    errors: dict[tuple[str, str], list[float]] = {}
    for index, (name, sigma_rows) in enumerate(SOURCES.items()):
        progress(index / len(SOURCES), name)
        for strength in STRENGTHS:
            target = _Target(line, line + apart, strength, sigma_rows)
            light = _irradiance(target)
            rows = (
                _event_rows(target, periods, effort.seed),
                _above_median(light),
                _above_half(_frame(light, rng)),
            )
            for method, found in zip(METHODS, rows, strict=True):
                error_px = np.nan_to_num(np.abs(found - line), nan=float(ROWS))
                errors.setdefault((name, method), []).append(float(np.median(error_px)))
    return Outcome(
        findings=_findings(errors),
        tables={
            "errors": DataTable(
                ["source", "method", *(f"strength_{s:g}" for s in STRENGTHS)],
                [[*key, *(round(value, 3) for value in row)] for key, row in errors.items()],
            )
        },
        figures={"errors": _figure(errors)},
        captions={
            "errors": "Median error of the row, px, against the strength of a static source "
            f"{APART_ROWS[0]:g} to {APART_ROWS[1]:g} rows beside the line",
        },
        remarks=list(_REMARKS),
    )


def _parts(target: _Target) -> tuple[Array, Array]:
    """Return line and source over columns and rows, each with the line's peak as 1."""
    y = np.arange(ROWS)
    parts = [
        np.exp(-0.5 * ((y - row[:, np.newaxis]) / sigma) ** 2)
        for row, sigma in (
            (target.line, preset("paper").sigma_rows),
            (target.source, target.sigma_rows),
        )
    ]
    return parts[0], target.strength * parts[1]


def _irradiance(target: _Target) -> Array:
    """Return the light on every pixel while the laser is on, as the event pixels have it."""
    pixels = preset("paper")
    line, source = _parts(target)
    return pixels.background_intensity + pixels.amplitude * (line + source)


def _event_rows(target: _Target, periods: int, seed: int) -> Array:
    """Return the row of each period and column from the events of a blinking line."""
    pixels = preset("paper")
    columns = target.line.size
    array = PixelArray(columns, ROWS, pixels, seed, background_hz=0.2)
    # No patch is brighter than the line on white: a stronger source is several.
    copies = max(int(np.ceil(target.strength)), 1)
    row = np.column_stack((target.line, *[target.source] * copies))
    sigma = np.full_like(row, target.sigma_rows)
    sigma[:, 0] = pixels.sigma_rows
    light = np.full_like(row, target.strength / copies)
    period_us = 1e6 / FREQUENCY_HZ
    for half in range(2 * (SETTLING + periods)):
        light[:, 0] = 1.0 - half % 2
        array.relight(
            round(0.5 * half * period_us), np.arange(columns), row, light, sigma_rows=sigma
        )
    end_us = round((SETTLING + periods) * period_us)
    array.run_until(end_us)
    t, x, y, _ = unpack(array.take(end_us))
    period = (t // period_us).astype(np.int64) - SETTLING
    group = period * columns + x
    order = np.argsort(group, kind="stable")[int(np.sum(period < 0)) :]
    offsets = np.searchsorted(group[order], np.arange(periods * columns + 1))
    found = estimate(y[order].astype(np.int64), offsets)
    return found.row.reshape(periods, columns)


def _above_median(light: Array) -> Array:
    """Return the centroid of what exceeds each column's median: no noise, no window."""
    weight = np.maximum(light - np.median(light, axis=1, keepdims=True), 0.0)
    return np.asarray(weight @ np.arange(ROWS) / weight.sum(axis=1))


def _frame(light: Array, rng: np.random.Generator) -> Array:
    """Return grey values of a frame camera: shot noise, brightest pixel just below saturation."""
    electrons = rng.poisson(light / light.max() * FULL_WELL)
    return np.minimum(np.floor(electrons / FULL_WELL * GREY_LEVELS), GREY_LEVELS - 1.0)


def _above_half(grey: Array) -> Array:
    """Return the centroid of the rows around the brightest that are above half of its height."""
    y = np.arange(ROWS)
    floor = np.median(grey, axis=1, keepdims=True)
    top = grey.argmax(axis=1)[:, np.newaxis]
    signal = grey - floor
    weight = np.where(signal > 0.5 * signal.max(axis=1, keepdims=True), signal, 0.0)
    weight[np.abs(y - top) > 3.0 * preset("paper").sigma_rows] = 0.0
    return np.asarray(weight @ y / weight.sum(axis=1))


def _findings(errors: dict[tuple[str, str], list[float]]) -> list[Finding]:
    wide, sharp = SOURCES
    one = STRENGTHS.index(1.0)
    events = errors[wide, "events"]
    return [
        Finding("events: error beside defocused light as bright as the line, over that without",
                events[one] / events[0], high=3.0),
        Finding("intensity centroid over events, beside defocused light of 0.1 of the line",
                errors[wide, "intensity centroid"][2] / events[2], low=10.0),
        Finding("frame camera over events, beside defocused light as bright as the line",
                errors[wide, "frame camera"][one] / events[one], low=2.0),
        Finding("frame camera over events, beside sharp light of 3 times the line",
                errors[sharp, "frame camera"][-1] / errors[sharp, "events"][-1], low=10.0),
        Finding("frame camera over events, without static light",
                errors[wide, "frame camera"][0] / events[0], high=1.0),
    ]  # fmt: skip


def _figure(errors: dict[tuple[str, str], list[float]]) -> Figure:
    figure = new_figure(11.0, 4.4)
    for axes, name in zip(figure.subplots(1, 2, sharey=True), SOURCES, strict=True):
        for method, style in zip(METHODS, ("o-", "s--", "^-"), strict=True):
            axes.plot(STRENGTHS, errors[name, method], style, label=method)
        axes.set_xscale("symlog", linthresh=0.03)
        axes.set(yscale="log", ylim=(0.03, 100.0))
        axes.set_xticks(STRENGTHS, [f"{strength:g}" for strength in STRENGTHS])
        axes.minorticks_off()
        axes.set(xlabel="static light over the line's peak", title=f"Static source: {name}")
        axes.grid(alpha=0.3)
    figure.axes[0].set_ylabel("median error of the row (px)")
    figure.axes[0].legend()
    return figure


_REMARKS = (
    "All three see the same irradiance while the laser is on. The intensity centroid has neither "
    "noise nor quantisation and uses what exceeds the column's median; the frame camera has shot "
    f"noise of {FULL_WELL:g} electrons, {GREY_LEVELS} grey levels and an exposure that the "
    "brightest pixel of the image fills, and uses the rows around the brightest that are above "
    "half of its height. A second frame without laser would remove the static light from both, at "
    "the price of its noise and of half the rate; pixels that see changes alone do so in the "
    "sensor.",
    "Without static light the frame camera is better: its noise is less than the mismatch of the "
    "event pixels' thresholds.",
)
EXPERIMENT = Experiment("static_light", "Static light: events against intensity", run)
