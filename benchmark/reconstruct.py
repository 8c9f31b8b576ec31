"""Speed of the reconstruction from EVT3 bytes to points, and its error, on a simulated line.

Usage: python benchmark/reconstruct.py [--seconds S] [--repeats N]

Every row is one pass over the same bytes in one thread, in CPU time; the best repeat counts. The
numpy reference is numpy from the bytes on: it decodes, accumulates each period in a frame and
computes column mean and standard deviation as the paper does. The last rows are numpy with events
from our decoder: the same, and the least possible, the column mean alone from two bincounts,
without spread, time or frame.
"""

from __future__ import annotations

import argparse
import platform
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Any

import numba
import numpy as np

from eschorty_ros.core.evt3 import Decoder
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.core.reconstruction import Profiles, Reconstructor, Settings, paper_method
from eschorty_ros.report.provenance import cpu_model
from eschorty_ros.simulation.scenes import Plane
from eschorty_ros.simulation.world import World

SEED = 1
RANGE_MM = 1320.0
CHUNK_BYTES = 1 << 20
BACKGROUND_SHARE = 0.05
CALIBRATION = load_calibration("config_3")
CASES = {
    "ours (mode_mean)": Settings(),
    "mean": Settings(centroid="mean"),
    "median": Settings(centroid="median"),
    "learned": Settings(centroid="learned"),
    "ours, all returns": Settings(returns="all"),
    "ours + activity filter": Settings(noise_filter="activity"),
    "ours + phase gate": Settings(phase_gate_us=1000),
    "ours + reflectance": Settings(reflectance="on"),
    "ours + compensation": Settings(reflectance_compensation="on"),
}


def simulated(modulation: Modulation, seconds: float) -> tuple[bytes, int]:
    """Return bytes and event count of a plane at 1.32 m, 1280 lit columns, 5 % background."""
    signal = World(Plane(RANGE_MM), CALIBRATION, seed=SEED, background_hz=0.0)
    signal.set_laser(0, True, modulation)
    signal.advance(int(0.3e6))
    signal_hz = signal.events / 0.3
    pixels = signal.columns * signal.rows
    background_hz = signal_hz * BACKGROUND_SHARE / (1 - BACKGROUND_SHARE) / pixels
    world = World(Plane(RANGE_MM), CALIBRATION, seed=SEED, background_hz=background_hz)
    world.set_laser(0, True, modulation)
    data = world.advance(int(seconds * 1e6))
    return data, world.events


def best(task: Callable[[], Any], repeats: int) -> tuple[float, Any]:
    task()
    shortest, result = float("inf"), Profiles.empty()
    for _ in range(repeats):
        began = time.process_time()
        result = task()
        shortest = min(shortest, time.process_time() - began)
    return shortest, result


def parts(data: bytes, modulation: Modulation, settings: Settings) -> Iterator[Profiles]:
    """Yield the profiles chunk by chunk, as a recording or a stream is reconstructed."""
    reconstructor = Reconstructor(CALIBRATION, modulation, settings)
    view = memoryview(data)
    for k in range(0, len(view), CHUNK_BYTES):
        yield reconstructor.push(view[k : k + CHUNK_BYTES])
    yield reconstructor.flush()


def ours(data: bytes, modulation: Modulation, settings: Settings) -> Profiles:
    return Profiles.concatenate(list(parts(data, modulation, settings)))


def plain(data: bytes, modulation: Modulation) -> Profiles:
    return paper_method.reconstruct(*paper_method.decode_all(data), CALIBRATION.model(), modulation)


def plain_after_decoding(data: bytes, modulation: Modulation) -> Profiles:
    events = Decoder().decode(data)
    return paper_method.reconstruct(events.t, events.x, events.y, CALIBRATION.model(), modulation)


def column_sums(data: bytes, modulation: Modulation) -> int:
    """Count the column means that two bincounts per period give."""
    events = Decoder().decode(data)
    last = int(int(events.t[-1]) // modulation.period_us) + 1
    cuts = np.searchsorted(events.t, [modulation.edge_us(k) for k in range(last + 1)])
    means = 0
    for a, b in pairwise(cuts):
        count = np.bincount(events.x[a:b], minlength=1280)
        total = np.bincount(events.x[a:b], weights=events.y[a:b], minlength=1280)
        means += np.count_nonzero(np.isfinite(total / np.maximum(count, 1)))
    return means


def decode(data: bytes) -> Profiles:
    decoder, view = Decoder(), memoryview(data)
    for k in range(0, len(view), 1 << 17):
        decoder.decode(view[k : k + (1 << 17)])
    return Profiles.empty()


def table(frequency_hz: float, seconds: float, repeats: int) -> None:
    modulation = Modulation(frequency_hz, on_edge_us=0)
    data, events = simulated(modulation, seconds)
    periods = int(seconds * frequency_hz)
    print(
        f"\n{frequency_hz:g} Hz, {seconds:g} s, {events / 1e6:.2f} Mevents "
        f"({events / periods / 1280:.1f} per column and period), {len(data) / events:.2f} B/event"
    )
    print(
        f"{'method':<24}{'Mev/s':>8}{'us/profile':>12}{'median mm':>11}{'p95 mm':>9}"
        f"{'points %':>10}{'x reference':>13}"
    )
    base_s, base = best(lambda: plain(data, modulation), max(repeats // 3, 1))
    rows = [("numpy reference", base_s, base)]
    for name, settings in CASES.items():
        rows.append((name, *best(lambda s=settings: ours(data, modulation, s), repeats)))
    for name, spent_s, found in rows:
        error_mm = np.abs(found.range_mm - RANGE_MM)
        print(
            f"{name:<24}{events / spent_s / 1e6:>8.1f}{spent_s / periods * 1e6:>12.0f}"
            f"{np.median(error_mm):>11.3f}{np.quantile(error_mm, 0.95):>9.3f}"
            f"{100 * len(found) / periods / 1280:>10.2f}{base_s / spent_s:>13.1f}"
        )
    for name, task in (
        ("(numpy, our decoder)", lambda: plain_after_decoding(data, modulation)),
        ("(column sums, ditto)", lambda: column_sums(data, modulation)),
        ("(decoding alone)", lambda: decode(data)),
    ):
        spent_s, _ = best(task, repeats)
        print(f"{name:<24}{events / spent_s / 1e6:>8.1f}{'':>42}{base_s / spent_s:>13.1f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=1.5, help="length of the 70 Hz stream")
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    print(
        f"{cpu_model()}; Python {platform.python_version()}, numpy {np.__version__}, "
        f"numba {numba.__version__}; seed {SEED}"
    )
    table(70.0, arguments.seconds, arguments.repeats)
    table(1000.0, arguments.seconds / 10, arguments.repeats)


if __name__ == "__main__":
    main()
