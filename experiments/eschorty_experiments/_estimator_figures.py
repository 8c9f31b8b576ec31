"""Measurements and pictures of the estimators' experiment."""

from __future__ import annotations

from itertools import cycle
from typing import TYPE_CHECKING, NamedTuple

from eschorty_ros.core.line import FULL_COLUMN_METHODS, METHODS
from eschorty_ros.report.figures import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WINDOWED = tuple(name for name in METHODS if name not in FULL_COLUMN_METHODS)
_MARKERS = "os^vDP"


class Case(NamedTuple):
    """One method on one kind of column."""

    method: str
    fwhm_px: float
    events: int
    background: float
    over_bound: float
    gross: float


class Second(NamedTuple):
    """Errors of one method beside a second line: of the strongest return, then of both."""

    method: str
    strength: float
    apart_fwhm: float
    over_bound: float
    gross: float
    reported: float
    near_over_bound: float
    far_over_bound: float


def bounds_figure(cases: list[Case]) -> Figure:
    """Draw the error over the bound against events, width and background share."""
    figure = new_figure(11.0, 4.6)
    panels = (
        ("events", "events per column", lambda c: c.fwhm_px == 20.0 and c.background == 0.1),
        ("fwhm_px", "FWHM (px)", lambda c: c.events == 30 and c.background == 0.1),
        ("background", "background share", lambda c: c.fwhm_px == 20.0 and c.events == 100),
    )
    titles = ("FWHM 20 px, 10 % background", "30 events, 10 % background", "FWHM 20 px, 100 events")
    for axes, (field, label, chosen), title in zip(
        figure.subplots(1, 3, sharey=True), panels, titles, strict=True
    ):
        for method, marker in zip(METHODS, cycle(_MARKERS), strict=False):
            line = [case for case in cases if case.method == method and chosen(case)]
            values = [getattr(case, field) for case in line]
            axes.plot(values, [case.over_bound for case in line], marker + "-", label=method)
        axes.axhline(1.1, color="0.5", linestyle=":", label="1.1 x the bound")
        axes.set(xlabel=label, title=title, yscale="log", ylim=(0.9, 100.0))
        if field != "background":
            axes.set_xscale("log")
            axes.set_xticks(values, [f"{value:g}" for value in values])
        axes.minorticks_off()
        axes.set_yticks([1, 1.3, 2, 5, 10, 50], ["1", "1.3", "2", "5", "10", "50"])
        axes.grid(alpha=0.3)
    figure.axes[0].set_ylabel("error over the Cramer-Rao bound")
    figure.axes[0].legend(fontsize="small", loc="upper left", ncols=2)
    return figure


def returns_figure(cases: list[Case], seconds: list[Second]) -> Figure:
    """Draw the shares of gross errors and of reported second lines."""
    figure = new_figure(11.0, 4.4)
    gross, strength, apart = figure.subplots(1, 3)
    for method, marker in zip(METHODS, cycle(_MARKERS), strict=False):
        kind = (method, 20.0, 0.3)
        line = [case for case in cases if (case.method, case.fwhm_px, case.background) == kind]
        shares = [100.0 * case.gross for case in line]
        gross.plot([case.events for case in line], shares, marker + "-", label=method)
    gross.axhline(1.5, color="0.5", linestyle=":", label="1.5 %")
    gross.set_yscale("symlog", linthresh=1.0)
    gross.set(xlabel="events per column", ylabel="gross errors or no row (%)", ylim=(-0.1, 100.0),
              title="FWHM 20 px, 30 % background")  # fmt: skip
    gross.set_yticks([0, 1, 10, 100], ["0", "1", "10", "100"])
    gross.legend(fontsize="small")
    # The windows are the same for every method, hence the returns.
    same = [case for case in seconds if case.method == WINDOWED[0]]
    far = max(case.apart_fwhm for case in same)
    line_at = [case for case in same if case.apart_fwhm == far]
    strength.plot([c.strength for c in line_at], [100 * c.reported for c in line_at], "o-")
    line_at = [case for case in same if case.apart_fwhm != far]
    apart.plot([c.apart_fwhm for c in line_at], [100 * c.reported for c in line_at], "o-")
    strength.axvline(0.5, color="0.5", linestyle=":")
    apart.axvline(2.0, color="0.5", linestyle=":")
    strength.set(xlabel="strength over that of the first", ylabel="second return reported (%)",
                 title=f"{far:g} FWHM apart")  # fmt: skip
    apart.set(xlabel="distance (FWHM)", title="0.8 as strong")
    for axes in (gross, strength, apart):
        axes.grid(alpha=0.3)
    return figure
