"""Write docs/performance.md: the speed of decoding and reconstruction on this computer.

Usage: python benchmark/performance.py [--seconds S] [--repeats N] [--out FILE]
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import platform
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numba
import numpy as np
import reconstruct as single
import scipy

from eschorty_ros.core.evt3.words import TIME_HIGH
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import save_calibration
from eschorty_ros.core.reconstruction import Settings, reconstruct_recording, warm_up
from eschorty_ros.core.storage import (
    CALIBRATION_FILE,
    EVENTS_FILE,
    LASER_FILE,
    STAGE_FILE,
    load_recording,
    write_laser_yaml,
    write_stage_csv,
)
from eschorty_ros.core.storage.raw_file import RawWriter
from eschorty_ros.report.provenance import cpu_model

HEAD = """# Speed of the reconstruction

Made by `python benchmark/performance.py`.

{computer}
{versions}
Simulated plane at {range_m} m, 1280 lit columns, {background:.0%} background, seed {seed}. Best of
{repeats} runs that alternate. The load average was {load:.1f} at the start, of other programs.

## One thread

CPU time from EVT3 bytes to ranges with the default settings. *Decoding* is from the bytes to event
arrays alone, the *ratio* what the reconstruction reaches of it in the same run. The paper's method
is in plain numpy, with arrays of all events at once; the streams last 4 s and 1.6 s. Each has run
once before: the first run of the paper's method, which takes its memory from the system, has twice
to three times the time.
"""
LARGE_BYTES = 2 << 30
ONE_THREAD = (
    "laser", "events", "per column and period", "decoding, Mev/s", "to ranges, Mev/s", "ratio",
    "paper, Mev/s", "times the paper",
)  # fmt: skip
THREADS_TEXT = """
## Threads

`reconstruct_recording` as `eschorty reconstruct --jobs N` runs it, in a process of its own: the
recording is read from the disk's cache and cut into windows of two million events, and each of N
threads decodes windows and turns them into points, which go to a file. An *estimated* phase of the
laser, as that of recorded scans is, is tracked by one thread before the others begin. *Wall* is
from the file to placed points and the check of the laser's frequency. The clouds are compared bit
for bit. *Memory* is the most of its own that the process held (mapped pages of the files, which the
system takes back when it needs them, are not its own), *before* what it held with everything
imported and compiled, *points* the size of their file.
"""
THREADS = (
    "laser", "phase", "file, MB", "events", "threads", "wall, s", "CPU, s", "Mev/s",
    "times one thread", "same points", "memory, MB", "before, MB", "points, MB",
)  # fmt: skip
LIVE_TEXT = """
## Through ROS 2

`benchmark/live.py`: another process publishes event packets of 1 or 4 ms and the stage's odometry
at a multiple of real time, a reconstruction node publishes every profile and the points of each
50 ms, and a third process receives both. *per CPU s* counts all of the node's process, *offline* is
the same code without ROS. *MB* is the node's memory at the start and at the end. Latency is from
the end of a period to the arrival of its profile; at half of real time a packet takes twice its
time to fill. *first ms* is that of the first profile, which waits while the first events choose the
periods of a profile. *median* and *p99* are of those after the first second.
"""


def header(names: tuple[str, ...]) -> str:
    """Return the first lines of a table."""
    return f"\n| {' | '.join(names)} |\n|{' ---: |' * len(names)}\n"


class Run(NamedTuple):
    """Times of one run, its events, memory and points."""

    wall_s: float
    cpu_s: float
    events: int
    memory_mb: float
    before_mb: float
    points_mb: float
    points: str


def write_recording(folder: Path, modulation: Modulation, data: bytes, repeats: int) -> Path:
    """Write a recording of a stage at rest: ``data`` that many times, each whole periods later."""
    folder.mkdir()
    write_laser_yaml(folder / LASER_FILE, modulation)
    save_calibration(single.CALIBRATION, folder / CALIBRATION_FILE)
    write_stage_csv(folder / STAGE_FILE, [0, 1 << 40], [0.0, 0.0])
    with RawWriter(folder / EVENTS_FILE) as file:
        words = np.frombuffer(data, "<u2").copy()
        is_high = words >> 12 == TIME_HIGH
        whole = 1_000_000 // math.gcd(round(4096 * modulation.frequency_hz), 1_000_000)
        last = int((words[is_high] & 0xFFF)[-1])
        steps = -(-(last + 2) // whole) * whole
        if steps - last > 0x7FF:
            raise ValueError(f"the stream ends {steps - last} steps early; choose other --seconds")
        for _ in range(repeats):
            file.write(words.tobytes())
            words[is_high] = TIME_HIGH << 12 | ((words[is_high] + steps) & 0xFFF)
    return folder


def measured(folder: Path, jobs: int) -> Run:
    """Reconstruct a recording in another process."""
    command = [sys.executable, __file__, "--recording", str(folder), "--jobs", str(jobs)]
    return Run(*json.loads(subprocess.check_output(command)))


def measure(folder: Path, jobs: int) -> Run:
    """Reconstruct a recording in this process."""
    recording = load_recording(folder)
    warm_up(recording.calibration)
    before_mb = memory_mb()
    most_mb = [before_mb]
    ended = threading.Event()

    def watch() -> None:
        while not ended.wait(0.02):
            most_mb.append(max(most_mb.pop(), memory_mb()))

    watching = threading.Thread(target=watch)
    watching.start()
    cpu = time.process_time()
    with tempfile.TemporaryDirectory(dir=folder) as made:
        result = reconstruct_recording(recording, jobs=jobs, folder=Path(made))
        spent = result.seconds, time.process_time() - cpu
        ended.set()
        watching.join()
        points = hashlib.sha256(result.points).hexdigest()
        size_mb = result.points.nbytes / 1e6
    return Run(*spent, result.events, *most_mb, before_mb, size_mb, points)


def memory_mb() -> float:
    """Return the memory of this process without pages of files."""
    status = Path("/proc/self/status").read_text().splitlines()
    (line,) = (x for x in status if x.startswith("RssAnon"))
    return int(line.split()[1]) / 1e3


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
        lambda: sum(map(len, single.parts(data, modulation, Settings()))),
    )
    for task in tasks:
        task()
    decoding_s, ours_s = np.min([[cpu_s(task) for task in tasks] for _ in range(repeats)], axis=0)
    # By itself: what it allocates would slow down the others.
    plain_s = min([cpu_s(lambda: single.plain(data, modulation)) for _ in range(repeats + 1)][1:])
    return (
        f"| {frequency_hz:g} Hz | {events / 1e6:.1f} M | "
        f"{events / (seconds * frequency_hz) / 1280:.1f} | {events / decoding_s / 1e6:.0f} | "
        f"{events / ours_s / 1e6:.0f} | {decoding_s / ours_s:.2f} | {events / plain_s / 1e6:.1f} | "
        f"{plain_s / ours_s:.0f} |\n"
    )


def threads(recording: Path, modulation: Modulation, repeats: int) -> str:
    """Return the rows of the second table for a recording with a laser."""
    write_laser_yaml(recording / LASER_FILE, modulation)
    phase = "estimated" if modulation.on_edge_us is None else "known"
    counts = sorted({1, 2, len(os.sched_getaffinity(0))})
    runs = [[measured(recording, jobs) for jobs in counts] for _ in range(repeats)]
    size_mb = (recording / EVENTS_FILE).stat().st_size / 1e6
    alone_s = min(row[0].wall_s for row in runs)
    rows = ""
    for jobs, same in zip(counts, zip(*runs, strict=True), strict=True):
        wall_s, cpu = np.min([one[:2] for one in same], axis=0)
        equal = all(one.points == runs[0][0].points for one in same)
        events, memory_mb = same[0].events, max(one.memory_mb for one in same)
        rows += (
            f"| {modulation.frequency_hz:g} Hz | {phase} | {size_mb:.0f} | {events / 1e6:.1f} M | "
            f"{jobs} | {wall_s:.2f} | {cpu:.2f} | {events / wall_s / 1e6:.0f} | "
            f"{alone_s / wall_s:.2f} | {'yes' if equal else 'NO'} | {memory_mb:.0f} | "
            f"{same[0].before_mb:.0f} | {same[0].points_mb:.0f} |\n"
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=12.0, help="length of the recording")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("docs/performance.md"))
    parser.add_argument("--recording", type=Path, help="reconstruct it and print the run")
    parser.add_argument("--jobs", type=int, help="threads for --recording")
    arguments = parser.parse_args()
    if arguments.recording is not None:
        print(json.dumps(measure(arguments.recording, arguments.jobs)))
        return
    cores = len(os.sched_getaffinity(0))
    text = HEAD.format(
        computer=f"{cpu_model()}, {cores} cores, {platform.system()} {platform.machine()}.",
        versions=f"Python {platform.python_version()}, numpy {np.__version__}, "
        f"scipy {scipy.__version__}, numba {numba.__version__}.",
        range_m=single.RANGE_MM * 1e-3,
        background=single.BACKGROUND_SHARE,
        seed=single.SEED,
        repeats=arguments.repeats,
        load=os.getloadavg()[0],
    )
    text += header(ONE_THREAD)
    for frequency_hz, share in ((70.0, 1.0), (1000.0, 0.4)):
        text += one_thread(frequency_hz, 4.0 * share, arguments.repeats)
    text += THREADS_TEXT + header(THREADS)
    with tempfile.TemporaryDirectory() as made:
        for frequency_hz, share in ((70.0, 1.0), (1000.0, 0.15)):
            modulation = Modulation(frequency_hz, on_edge_us=0)
            data, _ = single.simulated(modulation, arguments.seconds * share)
            for number, repeats in ((1, arguments.repeats), (LARGE_BYTES // len(data), 1)):
                name = f"{frequency_hz:g}_{number}"
                recording = write_recording(Path(made) / name, modulation, data, number)
                for laser in (modulation, replace(modulation, on_edge_us=None)):
                    text += threads(recording, laser, repeats)
                (recording / EVENTS_FILE).unlink()
    live = [sys.executable, str(Path(__file__).with_name("live.py"))]
    fast = ("--frequency", "70", "--packet-ms", "1", "--rate", "5")
    table = subprocess.check_output([*live, "--rate", "0.5", "1"], text=True)
    row = subprocess.check_output([*live, *fast], text=True).splitlines()[-1]
    text += f"{LIVE_TEXT}\n```text\n{table}{row}\n```\n"
    arguments.out.write_text(text)
    print(text)


if __name__ == "__main__":
    main()
