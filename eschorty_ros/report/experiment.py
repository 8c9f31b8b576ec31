"""Results of an experiment of the report: findings with their bands, tables and figures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Progress = Callable[[float, str], None]
"""Called with the share done (0 to 1) and a few words."""


@dataclass(frozen=True, slots=True)
class Effort:
    """Size of a run: the same code with more or fewer columns, periods and repeats.

    Attributes
    ----------
    fast : bool
        A coarse run for tests.
    seed : int
        Seed of everything random.
    """

    fast: bool = False
    seed: int = 1

    def choose(self, full: int, fast: int) -> int:
        """Return ``full``, or ``fast`` in a fast run."""
        return fast if self.fast else full


@dataclass(frozen=True, slots=True)
class Finding:
    """One number and the band that it must be within, both ends included.

    Attributes
    ----------
    name : str
        Its name, without the value.
    value, low, high : float
        ``-inf`` or ``inf`` for an open end.
    unit : str
    """

    name: str
    value: float
    low: float = -math.inf
    high: float = math.inf
    unit: str = ""

    @property
    def holds(self) -> bool:
        """True when the value is within its band; NaN never is."""
        return self.low <= self.value <= self.high


@dataclass(frozen=True, slots=True)
class DataTable:
    """A table of the report, written as CSV beside the page.

    Attributes
    ----------
    columns : sequence of str
        Names with their units, as in ``range_mm``.
    rows : sequence of sequence
        Numbers or text, one entry per column.
    shown : bool
        Show it on the page; the data behind a figure need not be.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[float | int | str]]
    shown: bool = True


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of one experiment.

    Attributes
    ----------
    findings : list of Finding
    tables : dict
        By file stem.
    figures : dict
        By file stem.
    captions : dict
        What a table or figure shows, by the same stems.
    remarks : list of str
        Sentences for the reader: explained disagreements, costs, omissions.
    """

    findings: list[Finding] = field(default_factory=list)
    tables: dict[str, DataTable] = field(default_factory=dict)
    figures: dict[str, Figure] = field(default_factory=dict)
    captions: dict[str, str] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Experiment:
    """A part of the report.

    Attributes
    ----------
    name : str
        For the command line and the file names.
    title : str
        Heading on the page.
    run : callable
        ``run(effort, progress) -> Outcome``.
    """

    name: str
    title: str
    run: Callable[[Effort, Progress], Outcome]
