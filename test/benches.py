"""Emulated benches for tests: in this process, or in one of their own."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from eschorty_ros.emulation.bench_devices import Bench, BenchSettings
from eschorty_ros.emulation.bench_process import bench_process
from eschorty_ros.emulation.bench_server import serving


@contextlib.contextmanager
def short_folder() -> Iterator[Path]:
    """A folder whose path leaves room for a Unix socket's."""
    with tempfile.TemporaryDirectory(prefix="bench_") as folder:
        yield Path(folder)


@contextlib.contextmanager
def bench_here(**settings: Any) -> Iterator[tuple[Bench, Path]]:
    """A bench of these ``BenchSettings`` in this process, and the folder it serves."""
    bench = Bench(BenchSettings(**settings))
    with short_folder() as folder, serving(bench, folder):
        yield bench, folder


@contextlib.contextmanager
def bench_elsewhere(**options: Any) -> Iterator[Path]:
    """The folder of a bench with these options in a process of its own."""
    with short_folder() as folder:
        names = {name.replace("_", "-"): value for name, value in options.items()}
        with bench_process(folder, names):
            yield folder
