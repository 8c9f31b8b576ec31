"""Results of an experiment of the report: findings with their bands, tables and figures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from eschorty_ros.core.base.progress import Progress


@dataclass(frozen=True, slots=True)
class Effort:
    """Size of a run: the same code with more or fewer columns, periods and repeats."""

    fast: bool
    """A coarse run for tests."""
    seed: int
    """Seed of everything random."""

    def choose(self, full: int, fast: int) -> int:
        """Return ``full``, or ``fast`` in a fast run."""
        return fast if self.fast else full


@dataclass(frozen=True, slots=True)
class Finding:
    """One number and the band that it must be within, both ends included."""

    name: str
    """Its name, without the value."""
    value: float
    low: float = -math.inf
    high: float = math.inf
    """``-inf`` or ``inf`` for an open end."""
    unit: str = ""

    @property
    def holds(self) -> bool:
        """Return whether the value is within its band; NaN never is."""
        return self.low <= self.value <= self.high


@dataclass(frozen=True, slots=True)
class DataTable:
    """A table of the report, written as CSV beside the page."""

    columns: Sequence[str]
    """Names with their units, as in ``range_mm``."""
    rows: Sequence[Sequence[float | int | str]]
    """Numbers or text, one entry per column."""
    shown: bool = True
    """Show it on the page; the data behind a figure need not be."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of one experiment."""

    findings: list[Finding] = field(default_factory=list)
    tables: dict[str, DataTable] = field(default_factory=dict)
    """By file stem."""
    figures: dict[str, Figure] = field(default_factory=dict)
    """By file stem."""
    captions: dict[str, str] = field(default_factory=dict)
    """What a table or figure shows, by the same stems."""
    remarks: list[str] = field(default_factory=list)
    """Sentences for the reader: explained disagreements, costs, omissions."""


@dataclass(frozen=True, slots=True)
class Experiment:
    """A part of the report."""

    name: str
    """For the command line and the file names."""
    title: str
    """Heading on the page."""
    run: Callable[[Effort, Progress], Outcome]
    """``run(effort, progress) -> Outcome``."""
