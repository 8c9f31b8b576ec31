"""The experiments of the report, one module each; every module offers ``EXPERIMENT``."""

from __future__ import annotations

from importlib import import_module

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.report.experiment import Experiment

NAMES: tuple[str, ...] = (
    "tables",
    "range_curves",
    "modulation_sweep",
    "reflectance_step",
    "scans",
    "estimators",
    "static_light",
    "effects",
    "calibration",
    "calibrated_scan",
    "tradeoff",
    "sigma",
)
"""Module of each experiment, in the order of the page."""


def load(name: str) -> Experiment:
    """Return an experiment by name.

    Raises ``ArgumentError`` when there is none of that name.
    """
    if name not in NAMES:
        raise ArgumentError(f"experiment is {name!r}; choose one of {', '.join(NAMES)}")
    experiment = import_module(f"{__name__}.{name}").EXPERIMENT
    assert isinstance(experiment, Experiment)
    return experiment
