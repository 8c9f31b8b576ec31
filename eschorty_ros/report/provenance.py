"""Versions and machine that a report was made with."""

from __future__ import annotations

import datetime
import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import eschorty_ros
from eschorty_ros.report.experiment import Effort

LIBRARIES = ("numpy", "numba", "matplotlib")


def provenance(effort: Effort) -> dict[str, str]:
    """Return versions, machine, seed and effort, as text by name."""
    made = {
        "Made": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "eschorty_ros": eschorty_ros.__version__,
        "Python": platform.python_version(),
    }
    made |= {name: _version(name) for name in LIBRARIES}
    return made | {
        "System": f"{platform.system()} {platform.machine()}",
        "CPU": f"{cpu_model()}, {len(os.sched_getaffinity(0))} usable",
        "Seed": str(effort.seed),
        "Effort": "fast: a coarse run" if effort.fast else "full",
    }


def cpu_model() -> str:
    """Return the name of the processor as the system reports it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    for line in lines:
        key, _, value = line.partition(":")
        if key.strip() == "model name":
            return value.strip()
    return platform.processor() or "unknown"


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "unknown"
