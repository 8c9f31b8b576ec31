"""Progress bars, tables and numbers as text."""

from __future__ import annotations

import math
import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.table import Table

    from eschorty_ros.core.base.progress import Progress
    from eschorty_ros.report.accuracy import Accuracy

LINE_EVERY_S = 5.0
_FILE_COLUMNS = 200
LESS_THAN_ALL = 0.99


@contextmanager
def progress_bar(title: str) -> Iterator[Progress]:
    """Show the share done on stderr: a bar on a terminal, else a line when it has changed.

    The share stays below 100 % until the block ends. Lines are some seconds apart.
    """
    from rich import progress
    from rich.console import Console

    bar = progress.Progress(
        progress.TextColumn("{task.description}"),
        progress.BarColumn(),
        progress.TextColumn("{task.percentage:3.0f} %"),
        progress.TimeRemainingColumn(),
        progress.TextColumn("{task.fields[note]}"),
        console=Console(file=sys.stderr),
        transient=True,
        disable=not sys.stderr.isatty(),
    )
    task = bar.add_task(title, total=1.0, note="")
    newest, ended = (0.0, ""), threading.Event()

    def report(share: float, note: str) -> None:
        nonlocal newest
        newest = min(share, LESS_THAN_ALL), note
        bar.update(task, completed=newest[0], note=note)

    def print_lines() -> None:
        printed = ""
        while not ended.wait(LINE_EVERY_S):
            share, note = newest
            line = f"{title}: {share:.0%} {note}".rstrip()
            if line != printed:
                print(line, file=sys.stderr, flush=True)
                printed = line

    if bar.disable:
        threading.Thread(target=print_lines, daemon=True).start()
    try:
        with bar:
            yield report
    finally:
        ended.set()


def of_total(report: Progress) -> Callable[[int, int], None]:
    """Return what reports how many are done, given their number and that of all."""
    return lambda done, total: report(done / max(total, 1), "")


def warn(text: str) -> None:
    """Print a warning on stderr."""
    print(f"eschorty: warning: {text}", file=sys.stderr, flush=True)


def table(title: str, *columns: str) -> Table:
    """Return an empty table; the first column is left aligned, the others right."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    shown = Text(title, "table.title", no_wrap=True, overflow="ignore")
    made = Table(title=shown, box=box.SIMPLE_HEAD, title_justify="left")
    for index, column in enumerate(columns):
        made.add_column(column, justify="left" if index == 0 else "right", overflow="fold")
    return made


def show(made: Table) -> None:
    """Print a table to stdout."""
    from rich.console import Console

    free = not sys.stdout.isatty() and "COLUMNS" not in os.environ
    Console(file=sys.stdout, width=_FILE_COLUMNS if free else None).print(made, crop=False)


def decimals(values: Iterable[float]) -> int:
    """Return the decimals with which each of ``values`` shows three digits or more."""
    sizes = [abs(value) for value in values if value and math.isfinite(value)]
    return max(2 - math.floor(math.log10(min(sizes))), 0) if sizes else 0


def pairs(title: str, rows: dict[str, str]) -> None:
    """Print names and values as a two-column table."""
    made = table(title, "", "")
    for name, value in rows.items():
        made.add_row(name, value)
    made.show_header = False
    show(made)


def accuracy_rows(measured: Accuracy) -> dict[str, str]:
    """Return a cloud's errors as rows of a table."""
    flagged = {"points with a flag": f"{measured.flagged:,}"}
    if math.isnan(measured.error_median_mm):
        return flagged | {"range error": "no point has a known range"}
    good = "none"
    if not math.isnan(measured.good_median_mm):
        good = (
            f"{measured.good_median_mm:.3f} mm, {measured.good_p95_mm:.3f} mm; "
            f"{measured.good_within_1_sigma:.1%}, {measured.good_within_2_sigma:.1%}"
        )
    return {
        "points": f"{measured.points:,} ({measured.off_target:,} where nothing is)",
        "complete": f"{measured.completeness:.2%} of {measured.periods:,} whole profiles",
        "median |range error|": f"{measured.error_median_mm:.3f} mm",
        "95th percentile": f"{measured.error_p95_mm:.3f} mm",
        "within 1 sigma, 2 sigma": f"{measured.within_1_sigma:.1%}, {measured.within_2_sigma:.1%}",
        **flagged,
        "without them": good,
    }
