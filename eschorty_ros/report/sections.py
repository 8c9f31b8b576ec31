"""Running experiments one after the other and writing their results."""

from __future__ import annotations

import csv
import io
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from eschorty_ros.core.base.files import atomic_write
from eschorty_ros.core.base.progress import Progress
from eschorty_ros.report import figures
from eschorty_ros.report.experiment import DataTable, Effort, Experiment, Finding, Outcome

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure as written."""

    file: str
    """Name beside the page."""
    caption: str
    alt: str
    """Its content in words, and a description of its axes for readers without the picture."""
    width_px: int
    height_px: int


@dataclass(frozen=True, slots=True)
class Sheet:
    """A table as written: ``file`` beside the page, and its data for the page itself."""

    file: str
    caption: str
    table: DataTable


@dataclass(frozen=True, slots=True)
class Section:
    """One experiment of the report, done or failed."""

    name: str
    title: str
    seconds: float
    """Its duration."""
    findings: Sequence[Finding] = field(default_factory=list)
    pictures: Sequence[Picture] = field(default_factory=list)
    sheets: Sequence[Sheet] = field(default_factory=list)
    remarks: Sequence[str] = field(default_factory=list)
    failure: str = ""
    """One line when the experiment failed, else empty."""
    trace: str = ""
    """Traceback of the failure."""

    @property
    def missed(self) -> list[Finding]:
        """Findings outside their band."""
        return [finding for finding in self.findings if not finding.holds]


def run_sections(
    names: Sequence[str],
    load: Callable[[str], Experiment],
    effort: Effort,
    folder: Path,
    progress: Progress,
) -> Iterator[Section]:
    """Run experiments in order; yield each as soon as its files are written.

    The section of an experiment that fails names its failure, and the next experiment runs.

    - ``load``: Returns the experiment of a name.
    - ``folder``: Existing folder for the files, named after experiment and stem.
    - ``progress``: Called with the share of all experiments done.
    """
    for index, name in enumerate(names):
        start = time.perf_counter()
        title = name

        def within(share: float, note: str, index: int = index, name: str = name) -> None:
            progress((index + min(max(share, 0.0), 1.0)) / len(names), f"{name} {note}")

        within(0.0, "")
        try:
            experiment = load(name)
            title = experiment.title
            outcome = experiment.run(effort, within)
            pictures, sheets = _write(name, outcome, folder)
        except Exception as error:
            message = " ".join(str(error).split()) or "no message"
            yield Section(
                name,
                title,
                time.perf_counter() - start,
                failure=f"{type(error).__name__}: {message}",
                trace=traceback.format_exc(),
            )
            continue
        yield Section(
            name,
            title,
            time.perf_counter() - start,
            outcome.findings,
            pictures,
            sheets,
            outcome.remarks,
        )


def picture(file: str, figure: Figure, caption: str) -> Picture:
    """Return a figure as written to a file."""
    width, height = (round(inches * figures.DPI) for inches in figure.get_size_inches())
    return Picture(file, caption, describe(figure) or caption, width, height)


def describe(figure: Figure) -> str:
    """Return title, axes and named lines of every part of a figure in words."""
    parts = []
    for axes in figure.axes:
        x, y = axes.get_xlabel(), axes.get_ylabel()
        if not (x or y):
            continue
        words = f"{y or 'values'} over {x}" if x else y
        if axes.get_title():
            words = f"{axes.get_title()}: {words}"
        legend = axes.get_legend()
        named = [text.get_text() for text in legend.get_texts()] if legend else []
        if named:
            words += f" ({', '.join(named)})"
        parts.append(words)
    return "; ".join(parts)


def _csv_text(table: DataTable) -> str:
    """Return header line and rows; numbers with all their digits."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(table.columns)
    for row in table.rows:
        writer.writerow([value if isinstance(value, str) else _digits(value) for value in row])
    return stream.getvalue()


def _digits(value: float) -> str:
    # The repr of a numpy number includes its type.
    return repr(value.item() if hasattr(value, "item") else value)


def _write(name: str, outcome: Outcome, folder: Path) -> tuple[list[Picture], list[Sheet]]:
    pictures = []
    for stem, figure in outcome.figures.items():
        file = f"{name}-{stem}.png"
        figures.save(figure, folder / file)
        pictures.append(picture(file, figure, outcome.captions.get(stem, stem)))
    sheets = []
    for stem, table in outcome.tables.items():
        file = f"{name}-{stem}.csv"
        with atomic_write(folder / file) as stream:
            stream.write(_csv_text(table).encode())
        sheets.append(Sheet(file, outcome.captions.get(stem, stem), table))
    return pictures, sheets
