"""Emulated benches for tests, in this process or in another."""

import contextlib
import json
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from command_process import CommandProcess, run_commands
from short_folder import short_folder

from eschorty_ros.emulation.bench import devices
from eschorty_ros.emulation.bench.devices import Bench, BenchSettings
from eschorty_ros.emulation.bench.server import serving
from eschorty_ros.hardware.base.priority import DEVICE_NICE, raise_priority
from eschorty_ros.simulation.scenes import Steps, named

NARROW_STEPS = Steps(column_levels_mm=(*[math.nan] * 3, 25.0, 60.0, *[math.nan] * 3))
"""``steps`` of a remote bench: two of its eight column bands, as a bench costs what is lit."""


@contextlib.contextmanager
def bench_here(**settings: Any) -> Iterator[tuple[Bench, Path]]:
    """Yield a bench with these ``BenchSettings`` in this process, and its folder."""
    bench = Bench(BenchSettings(**settings))
    with short_folder() as folder, serving(bench, folder):
        yield bench, folder


@contextlib.contextmanager
def remote_bench(**settings: Any) -> Iterator[tuple[CommandProcess, Path]]:
    """Yield a bench with these ``BenchSettings`` in another process, and its folder.

    The command is the scene from the next start of the stream on.
    """
    with short_folder() as folder, CommandProcess(__file__, folder, json.dumps(settings)) as other:
        yield other, folder


def serve(folder: str, settings: str) -> None:
    raise_priority(DEVICE_NICE)
    devices.named = lambda name, model: NARROW_STEPS if name == "steps" else named(name, model)
    bench = Bench(BenchSettings(**json.loads(settings)))
    with serving(bench, Path(folder)):
        run_commands(bench.set_scene)


if __name__ == "__main__":
    serve(*sys.argv[1:])
