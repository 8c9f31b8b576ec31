"""Time against error of every setting, one panel per background."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from eschorty_experiments._scan_errors import ScanErrors
from eschorty_experiments._tradeoff_runs import BACKGROUND_SHARES, SMOOTHING, Variant
from eschorty_experiments._tradeoff_tables import Summary, pareto_front
from eschorty_ros.core.line import CENTROIDS
from eschorty_ros.report.figures import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MARKERS = "osD^vP"


def pareto_figure(summaries: Sequence[Summary]) -> Figure:
    """Draw log-log panels with the front marked, the default ringed, the baseline a star."""
    figure = new_figure(13.5, 8.6)
    filters = list(dict.fromkeys(one.variant.filters for one in summaries))
    for row, (name, error_mm) in enumerate(_ERRORS.items()):
        first: Axes | None = None
        for k, share in enumerate(BACKGROUND_SHARES):
            number = row * len(BACKGROUND_SHARES) + k + 1
            axes = figure.add_subplot(
                len(_ERRORS), len(BACKGROUND_SHARES), number, sharex=first, sharey=first
            )
            first = first or axes
            _panel(axes, [one for one in summaries if one.background_share == share], error_mm)
            axes.set(xlabel="time (ns per event)", title=f"{100 * share:g} % background")
            if k == 0:
                axes.set_ylabel(f"{name} of the range error (mm)")
    _legend(figure, filters)
    return figure


_ERRORS: dict[str, Callable[[ScanErrors], float]] = {
    "root mean square": lambda errors: errors.rmse_mm,
    "95th percentile": lambda errors: errors.quantile_mm(0.95),
}


def _panel(
    axes: Axes, summaries: Sequence[Summary], error_mm: Callable[[ScanErrors], float]
) -> None:
    from matplotlib.ticker import LogLocator

    points = [(one.ns_per_event, error_mm(one.errors)) for one in summaries]
    filters = list(dict.fromkeys(one.variant.filters for one in summaries))
    front = pareto_front(points)
    for k, one in enumerate(summaries):
        _mark(axes, one.variant, points[k], filters, k in front)
    line = np.array([points[k] for k in front])
    axes.step(line[:, 0], line[:, 1], "k-", where="post", linewidth=1.0, zorder=1)
    axes.set(xscale="log", yscale="log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("")
    axes.grid(alpha=0.3, which="both")


def _mark(
    axes: Axes,
    variant: Variant,
    where: tuple[float, float],
    filters: Sequence[str],
    on_front: bool,
) -> None:
    if variant.settings is None:
        axes.plot(*where, "k*", markersize=13)
        return
    colour = f"C{CENTROIDS.index(variant.estimator)}"
    axes.plot(
        *where,
        _MARKERS[filters.index(variant.filters) % len(_MARKERS)],
        color=colour,
        markersize=4.0 + 3.0 * SMOOTHING.index(variant.half_width),
        markerfacecolor=colour if on_front else "none",
        zorder=2,
    )
    if variant.is_default:
        axes.plot(*where, "o", color="red", markersize=18, markerfacecolor="none", zorder=3)


def _legend(figure: Figure, filters: Sequence[str]) -> None:
    from matplotlib.lines import Line2D

    def handle(marker: str, label: str, colour: str = "0.3", size: float = 6.0) -> Line2D:
        return Line2D(
            [], [], color=colour, marker=marker, linestyle="", markersize=size, label=label,
            markerfacecolor="none",
        )  # fmt: skip

    handles = [handle("*", "numpy baseline", "k", 12.0), handle("o", "default", "red", 14.0)]
    handles += [handle("o", method, f"C{k}") for k, method in enumerate(CENTROIDS)]
    handles += [
        handle(_MARKERS[k % len(_MARKERS)], f"filter {name}") for k, name in enumerate(filters)
    ]
    handles += [
        handle("o", f"smoothing {half_width}", size=4.0 + 3.0 * k)
        for k, half_width in enumerate(SMOOTHING)
    ]
    figure.legend(handles=handles, loc="outside right center", frameon=False, labelspacing=0.9)
