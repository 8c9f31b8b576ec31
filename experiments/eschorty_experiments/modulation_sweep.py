"""Fig. 6: events per second and line width over the modulation frequency."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING

import numpy as np

from eschorty_experiments._line_width import (
    LINE_ROW,
    ROWS,
    Point,
    closed_form_width,
    measure,
)
from eschorty_ros.core.base.progress import Progress
from eschorty_ros.report.experiment import (
    DataTable,
    Effort,
    Experiment,
    Finding,
    Outcome,
)
from eschorty_ros.report.figures import new_figure
from eschorty_ros.simulation.pixels import PixelParameters, preset

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PRESETS = ("paper", "narrow")
FAST_HZ = (50.0, 100.0, 200.0, 350.0, 500.0, 1000.0, 2000.0, 5000.0, 10_000.0, 20_000.0)
FULL_HZ = (50.0, 70.0, 100.0, 140.0, 200.0, 280.0, 350.0, 500.0, 600.0, 700.0, 850.0, 1000.0,
           1400.0, 2000.0, 2800.0, 4000.0, 5000.0, 7000.0, 10_000.0, 12_000.0, 14_000.0,
           17_000.0, 20_000.0)  # fmt: skip
SHOWN_HZ = (50.0, 1000.0, 5000.0, 10_000.0, 20_000.0)
SENSOR_COLUMNS = 1280
LINEAR_TO_HZ, SATURATED_HZ = 500.0, 1000.0
PRINTED_WIDTH_PX = (20.0, 2.0)


def run(effort: Effort, progress: Progress) -> Outcome:
    """Sweep both presets over the frequencies."""
    frequencies = FAST_HZ if effort.fast else FULL_HZ
    columns = effort.choose(128, 64)
    parameters = {name: preset(name) for name in PRESETS}
    sweeps: dict[str, list[Point]] = {}
    done = 0
    for name in PRESETS:
        sweeps[name] = []
        for frequency in frequencies:
            progress(done / (len(PRESETS) * len(frequencies)), f"{name} {frequency:g} Hz")
            periods = _periods(frequency, effort)
            sweeps[name].append(measure(parameters[name], frequency, columns, periods, effort.seed))
            done += 1
    return Outcome(
        findings=[*_findings("paper", sweeps["paper"], (1.0, 5.0)),
                  _closed_form_finding(sweeps["paper"], parameters["paper"]),
                  *_findings("narrow", sweeps["narrow"], (1.5, 2.5))],
        tables={"sweep": _table(sweeps, parameters)},
        figures={
            "events": _events_figure(sweeps),
            "width": _width_figure(sweeps, parameters),
            "footprint": _footprint_figure(sweeps),
        },
        captions={
            "sweep": "Events and width of the line at every frequency",
            "events": "Fig. 6A: events per second and column on a flat white target. The paper's "
            "regimes are shaded.",
            "width": "Fig. 6B and C: full width at half maximum in events, median over the "
            "columns with the 16th and 84th percentiles, and the closed form without noise "
            "(dashed).",
            "footprint": "Events over the rows of the line, each scaled to its maximum: the "
            "footprint narrows through breakdown.",
        },
        remarks=_remarks(sweeps, parameters),
    )  # fmt: skip


def _periods(frequency_hz: float, effort: Effort) -> int:
    """Return the periods of half a second, or fewer at high frequency and in a fast run."""
    return min(round(frequency_hz * effort.choose(500, 200) * 1e-3), effort.choose(2000, 400))


def _at(points: list[Point], frequency_hz: float) -> Point:
    return next(point for point in points if point.frequency_hz == frequency_hz)


def _findings(name: str, points: list[Point], narrowest_px: tuple[float, float]) -> list[Finding]:
    first = points[0]
    linear = [
        abs(point.rate_hz / (first.rate_hz * point.frequency_hz / first.frequency_hz) - 1.0)
        for point in points
        if point.frequency_hz <= LINEAR_TO_HZ
    ]
    half, one, last = (_at(points, hz).rate_hz for hz in (500.0, 1000.0, 20_000.0))
    falling = [point.width_px for point in points if point.frequency_hz >= SATURATED_HZ]
    return [
        Finding(f"{name}: events from 50 to 500 Hz, largest departure from a straight line",
                max(linear), high=0.12),
        Finding(f"{name}: events at 1 kHz over those at 500 Hz, saturation", one / half, high=1.5),
        Finding(f"{name}: events at 20 kHz over those at 1 kHz, breakdown", last / one, high=0.25),
        Finding(f"{name}: width at 50 Hz", first.width_px, 18.0, 22.0, "px"),
        Finding(f"{name}: width at 20 kHz", points[-1].width_px, *narrowest_px, "px"),
        Finding(f"{name}: largest widening from 1 kHz on, from one frequency to the next",
                float(np.max(np.diff(falling))), high=1.0, unit="px"),
    ]  # fmt: skip


def _closed_form_finding(points: list[Point], parameters: PixelParameters) -> Finding:
    apart = [
        abs(point.width_px - closed_form_width(parameters, point.frequency_hz)) for point in points
    ]
    return Finding("paper: largest difference of the width to the closed form", max(apart),
                   high=2.5, unit="px")  # fmt: skip


def _remarks(sweeps: dict[str, list[Point]], parameters: dict[str, PixelParameters]) -> list[str]:
    paper, narrow = sweeps["paper"], sweeps["narrow"]
    return [
        "Width: rows from the first to the last bin at half of the mean of the three highest, "
        "both ends counted, in each column alone; the lines are anywhere between two rows.",
        f"Counts peak at {_peak_hz(paper):g} Hz (paper) and {_peak_hz(narrow):g} Hz (narrow). The "
        "paper has them fall from about 1 kHz on; preset paper stays flat over some kHz and dips "
        "near 1 kHz: from 714 Hz on, half a period is shorter than the refractory time of 700 us, "
        "so that a pixel misses every other edge until at 1.4 kHz a whole period fits. All "
        "simulated pixels have the same time: a spread of 10 % halves the dip and one of 30 % "
        "removes it, so the paper's camera, whose times are unknown and surely differ, need not "
        "show it.",
        "Preset paper ends at "
        f"{paper[-1].width_px:g} rows at 20 kHz where the paper has 2: with noise on the swing "
        "rows beyond the edge fire occasionally. Preset narrow reaches "
        f"{narrow[-1].width_px:g} rows. It needs {_differences(parameters)}.",
        f"Its cost: at 20 kHz {narrow[-1].rate_hz:.0f} events per second and column are left "
        f"of {paper[-1].rate_hz:.0f} with preset paper, at 1 kHz "
        f"{_at(narrow, 1000.0).rate_hz:.0f} of {_at(paper, 1000.0).rate_hz:.0f}; a sensor with so "
        "little noise is a fit to the printed widths, not a measurement.",
        f"All {SENSOR_COLUMNS} columns of a white target make "
        f"{_at(paper, 50.0).rate_hz * SENSOR_COLUMNS * 1e-6:.1f} Mev/s at 50 Hz and "
        f"{max(point.rate_hz for point in paper) * SENSOR_COLUMNS * 1e-6:.0f} Mev/s at the most; "
        "the paper's 0.01 to 1 Mev/s means a partly filled line, filters or higher thresholds.",
        "The closed form assumes a pixel's reference at an end of its swing. After the refractory "
        "time it is anywhere in between, and only noise or a larger swing makes the pixel fire "
        "again: preset narrow, with little noise, ends below its closed form.",
        "Parameters are fitted to curves that the paper describes in words, as it publishes no "
        "data.",
    ]


def _peak_hz(points: list[Point]) -> float:
    return max(points, key=lambda point: point.rate_hz).frequency_hz


def _differences(parameters: dict[str, PixelParameters]) -> str:
    """Return the parameters in which the presets differ, as text."""
    pair = [asdict(parameters[name]) for name in PRESETS]
    return ", ".join(
        f"{key} {pair[1][key]:g} (paper {pair[0][key]:g})"
        for key in pair[0]
        if pair[0][key] != pair[1][key]
    )


def _table(sweeps: dict[str, list[Point]], parameters: dict[str, PixelParameters]) -> DataTable:
    rows: list[list[float | str]] = []
    for name, points in sweeps.items():
        slope = points[0].rate_hz / points[0].frequency_hz
        for point in points:
            low, high = np.percentile(point.widths_px, [16.0, 84.0])
            rows.append(
                [
                    name,
                    point.frequency_hz,
                    point.rate_hz,
                    point.rate_hz / (slope * point.frequency_hz),
                    point.rate_hz * SENSOR_COLUMNS * 1e-6,
                    point.width_px,
                    float(low),
                    float(high),
                    closed_form_width(parameters[name], point.frequency_hz),
                ]
            )
    return DataTable(
        [
            "preset",
            "frequency_hz",
            "events_per_s_and_column",
            "share_of_linear",
            "mev_per_s_all_columns",
            "width_px",
            "width_p16_px",
            "width_p84_px",
            "width_closed_form_px",
        ],
        rows,
    )


def _frequency_axes(figure: Figure) -> Axes:
    axes = figure.add_subplot()
    axes.set_xscale("log")
    axes.set_xlabel("modulation frequency (Hz)")
    axes.set_xticks(
        [50, 100, 200, 500, 1000, 2000, 5000, 10_000, 20_000],
        ["50", "100", "200", "500", "1k", "2k", "5k", "10k", "20k"],
    )
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    return axes


def _events_figure(sweeps: dict[str, list[Point]]) -> Figure:
    figure = new_figure(8.0, 4.8)
    axes = _frequency_axes(figure)
    for name, points in sweeps.items():
        axes.plot([p.frequency_hz for p in points], [p.rate_hz for p in points], "o-", ms=4,
                  label=name)  # fmt: skip
    slope = sweeps["paper"][0].rate_hz / sweeps["paper"][0].frequency_hz
    axes.plot([50.0, 1000.0], [slope * 50.0, slope * 1000.0], "k:", label="linear from 50 Hz")
    axes.axvspan(50.0, 500.0, color="tab:green", alpha=0.07, label="paper: linear")
    axes.axvspan(500.0, 1000.0, color="tab:orange", alpha=0.1, label="paper: saturating")
    axes.axvspan(1000.0, 20_000.0, color="tab:red", alpha=0.05, label="paper: breakdown")
    axes.set_yscale("log")
    axes.set(ylabel="events per second and column", title="Fig. 6A: events over frequency")
    axes.legend(loc="lower center", ncols=2, fontsize="small")
    return figure


def _width_figure(sweeps: dict[str, list[Point]], parameters: dict[str, PixelParameters]) -> Figure:
    figure = new_figure(8.0, 4.8)
    axes = _frequency_axes(figure)
    fine = np.geomspace(50.0, 20_000.0, 200)
    for index, (name, points) in enumerate(sweeps.items()):
        low, high = np.percentile([p.widths_px for p in points], [16.0, 84.0], axis=1)
        at, colour = [p.frequency_hz for p in points], f"C{index}"
        axes.fill_between(at, low, high, color=colour, alpha=0.2, linewidth=0.0)
        axes.plot(at, [p.width_px for p in points], "o-", ms=4, color=colour, label=name)
        width = [closed_form_width(parameters[name], hz) for hz in fine]
        axes.plot(fine, width, "--", color=colour, linewidth=1.0, label=f"{name}, closed form")
    axes.plot([50.0, 20_000.0], PRINTED_WIDTH_PX, "k*", ms=9, label="the paper's ends")
    axes.set(ylabel="width (px)", title="Fig. 6C: line width in events", ylim=(0.0, None))
    axes.legend(loc="lower left")
    return figure


def _footprint_figure(sweeps: dict[str, list[Point]]) -> Figure:
    figure = new_figure(11.0, 4.2)
    for axes, (name, points) in zip(
        figure.subplots(1, 2, sharey=True), sweeps.items(), strict=True
    ):
        for index, frequency in enumerate(SHOWN_HZ):
            rows_hz = _at(points, frequency).rows_hz
            axes.step(
                np.arange(ROWS) - LINE_ROW,
                rows_hz / max(float(rows_hz.max()), 1e-9),
                where="mid",
                color=f"C{index}",
                label=f"{frequency:g} Hz",
            )
        axes.set(
            xlabel="rows from the line's centre (px)",
            ylabel="events over their maximum",
            title=f"Fig. 6B: footprint, preset {name}",
            xlim=(-18.0, 18.0),
        )
        axes.legend(fontsize="small")
        axes.grid(alpha=0.3)
    return figure


EXPERIMENT = Experiment(
    "modulation_sweep", "Fig. 6: events and line width over the modulation frequency", run
)
