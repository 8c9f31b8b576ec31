"""Write docs/performance.md: the speed of decoding and reconstruction on this computer.

Usage: python benchmark/performance.py [--seconds S] [--repeats N] [--out FILE]
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import NamedTuple

import numba
import numpy as np
import reconstruct as single
import scipy

from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.reconstruction import Profiles, Reconstructor, Settings

HEAD = """# Speed of the reconstruction

Made by `python benchmark/performance.py`.

{computer}
{versions}
Simulated plane at {range_m} m, 1280 lit columns, {background:.0%} background, seed {seed}. Best of
{repeats} runs that alternate. The load average was {load:.1f} at the start, of other programs.

## One thread

CPU time from EVT3 bytes to ranges with the default settings. *Decoding* is from the bytes to event
arrays alone, the *ratio* what the reconstruction reaches of it in the same run. The paper's method
is in plain numpy.
"""
ONE_THREAD = (
    "laser", "events", "per column and period", "decoding, Mev/s", "to ranges, Mev/s", "ratio",
    "paper, Mev/s", "times the paper",
)  # fmt: skip
THREADS_TEXT = """
## Threads

`eschorty reconstruct --jobs N`: one thread more decodes and follows the phase, and the N turn
windows of two million events into rows. The points are compared bit for bit. *Most* is what the
CPU times allow on two free cores: that of one thread over the larger of half of all and that of
the decoding thread.
"""
THREADS = (
    "laser", "events", "threads", "wall, s", "CPU, s", "decoding thread, s", "Mev/s",
    "times one thread", "most", "same points",
)  # fmt: skip


def header(names: tuple[str, ...]) -> str:
    """Return the first lines of a table."""
    return f"\n| {' | '.join(names)} |\n|{' ---: |' * len(names)}\n"


class Run(NamedTuple):
    """Times of one run and what it found."""

    wall_s: float
    cpu_s: float
    first_s: float
    events: int
    found: Profiles


def run(data: bytes, modulation: Modulation, jobs: int) -> Run:
    """Reconstruct ``data`` with ``jobs`` threads."""
    reconstructor = Reconstructor(single.CALIBRATION, modulation, Settings(), jobs)
    view = memoryview(data)
    wall, cpu, first = time.perf_counter(), time.process_time(), time.thread_time()
    parts = [
        reconstructor.push(view[k : k + single.CHUNK_BYTES])
        for k in range(0, len(data), single.CHUNK_BYTES)
    ]
    found = Profiles.concatenate([*parts, reconstructor.flush()])
    spent = time.perf_counter() - wall, time.process_time() - cpu, time.thread_time() - first
    return Run(*spent, reconstructor.counters["events"], found)


def cpu_s(task: Callable[[], object]) -> float:
    """Return the CPU time of a task."""
    began = time.process_time()
    task()
    return time.process_time() - began


def one_thread(frequency_hz: float, seconds: float, repeats: int) -> str:
    """Return a row of the first table."""
    modulation = Modulation(frequency_hz, on_edge_us=0)
    data, events = single.simulated(modulation, seconds)
    tasks: tuple[Callable[[], object], ...] = (
        lambda: single.decode(data),
        lambda: single.ours(data, modulation, Settings()),
    )
    for task in tasks:
        task()
    decoding_s, ours_s = np.min([[cpu_s(task) for task in tasks] for _ in range(repeats)], axis=0)
    plain_s = cpu_s(lambda: single.plain(data, modulation))
    return (
        f"| {frequency_hz:g} Hz | {events / 1e6:.1f} M | "
        f"{events / (seconds * frequency_hz) / 1280:.1f} | {events / decoding_s / 1e6:.0f} | "
        f"{events / ours_s / 1e6:.0f} | {decoding_s / ours_s:.2f} | {events / plain_s / 1e6:.1f} | "
        f"{plain_s / ours_s:.0f} |\n"
    )


def threads(frequency_hz: float, seconds: float, repeats: int) -> str:
    """Return the rows of the second table."""
    modulation = Modulation(frequency_hz, on_edge_us=0)
    data, _ = single.simulated(modulation, seconds)
    counts = sorted({1, 2, len(os.sched_getaffinity(0))})
    runs = [[run(data, modulation, jobs) for jobs in counts] for _ in range(repeats)]
    serial = runs[0][0]
    rows = ""
    for jobs, same in zip(counts, zip(*runs, strict=True), strict=True):
        equal = all(
            np.array_equal(getattr(serial.found, item.name), getattr(one.found, item.name))
            for one in same
            for item in fields(Profiles)
        )
        best = Run(*np.min([one[:3] for one in same], axis=0), serial.events, serial.found)
        alone_s, alone_cpu_s = np.min([[row[0].wall_s, row[0].cpu_s] for row in runs], axis=0)
        most = alone_cpu_s / max(best.cpu_s / min(jobs, 2), best.first_s)
        rows += (
            f"| {frequency_hz:g} Hz | {best.events / 1e6:.1f} M | {jobs} | {best.wall_s:.2f} | "
            f"{best.cpu_s:.2f} | {best.first_s:.2f} | {best.events / best.wall_s / 1e6:.0f} | "
            f"{alone_s / best.wall_s:.2f} | {most:.2f} | {'yes' if equal else 'NO'} |\n"
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=12.0, help="length of the 70 Hz stream")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("docs/performance.md"))
    arguments = parser.parse_args()
    cores = len(os.sched_getaffinity(0))
    text = HEAD.format(
        computer=f"{single.cpu_name()}, {cores} cores, {platform.system()} {platform.machine()}.",
        versions=f"Python {platform.python_version()}, numpy {np.__version__}, "
        f"scipy {scipy.__version__}, numba {numba.__version__}.",
        range_m=single.RANGE_MM * 1e-3,
        background=single.BACKGROUND_SHARE,
        seed=single.SEED,
        repeats=arguments.repeats,
        load=os.getloadavg()[0],
        cores=cores,
    )
    text += header(ONE_THREAD)
    for frequency_hz, share in ((70.0, 1.0), (1000.0, 0.1)):
        text += one_thread(frequency_hz, 1.5 * share, arguments.repeats)
    text += THREADS_TEXT + header(THREADS)
    for frequency_hz, share in ((70.0, 1.0), (1000.0, 0.15)):
        text += threads(frequency_hz, arguments.seconds * share, arguments.repeats)
    arguments.out.write_text(text)
    print(text)


if __name__ == "__main__":
    main()
