"""Progress bars, tables and numbers as text."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.table import Table

    from eschorty_ros.report.accuracy import Accuracy

Report = Callable[[float, str], None]
"""Called with the share done (0 to 1) and a short text."""


@contextmanager
def progress_bar(title: str) -> Iterator[Report]:
    """Show a progress bar on stderr when that is a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
        console=Console(file=sys.stderr),
        transient=True,
        disable=not sys.stderr.isatty(),
    )
    task = bar.add_task(title, total=1.0, note="")

    def report(share: float, note: str) -> None:
        bar.update(task, completed=share, note=note)

    with bar:
        yield report


def table(title: str, *columns: str) -> Table:
    """Return an empty table; the first column is left aligned, the others right."""
    from rich import box
    from rich.table import Table

    made = Table(title=title, box=box.SIMPLE_HEAD, title_justify="left")
    for index, column in enumerate(columns):
        made.add_column(column, justify="left" if index == 0 else "right", no_wrap=True)
    return made


def show(made: Table) -> None:
    """Print a table to stdout."""
    from rich.console import Console

    console = Console(file=sys.stdout)
    if not sys.stdout.isatty():
        console = Console(file=sys.stdout, width=110)
    console.print(made)


def pairs(title: str, rows: dict[str, str]) -> None:
    """Print names and values as a two-column table."""
    made = table(title, "", "")
    for name, value in rows.items():
        made.add_row(name, value)
    made.show_header = False
    show(made)


def accuracy_rows(measured: Accuracy) -> dict[str, str]:
    """Return a cloud's errors as rows of a table."""
    return {
        "points": f"{measured.points:,} ({measured.off_target:,} where nothing is)",
        "complete": f"{measured.completeness:.2%} of {measured.periods:,} whole periods",
        "median |range error|": f"{measured.error_median_mm:.3f} mm",
        "95th percentile": f"{measured.error_p95_mm:.3f} mm",
        "within 1 sigma, 2 sigma": f"{measured.within_1_sigma:.1%}, {measured.within_2_sigma:.1%}",
    }
