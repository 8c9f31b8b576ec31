"""Speed of the simulated world: events per second and real-time factor against lit columns.

Run: python benchmark/simulation.py [--seconds 0.5] [--repeats 3]
One core; thread time, best of the repeats, the stage moving at 50 mm/s. Time grows with the events
as the lit columns do; the first line, the full sensor without laser, is background activity alone.

Measured on shared 2-core machines on several days, 640 columns or more: 4.4 to 5.8 Mev/s per core
on the steps at 70 to 500 Hz (4.3 to 5.1 on surfaces that move within a lit phase), 2.9 to 3.6 at
1 kHz; 0.7 to 0.8 at 5 kHz. All 1280 columns lit at 70 Hz run at 1.0 to 1.4 times real time. From
1 kHz on a pixel rarely starts from rest when the light changes: the risk of its noise is summed
up, not looked up, and begun again at each edge. A lit pixel and edge cost 60 to 100 ns at any
frequency, but at 5 kHz only one in 14 makes an event; with 160 columns a quarter of the time goes
into the edge itself.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

from eschorty_ros.core.clocks import plan_move
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.simulation.scenes import named
from eschorty_ros.simulation.world import BACKGROUND_HZ, World

CASES = [
    ("steps", 0, 70.0),
    ("steps", 160, 70.0),
    ("steps", 640, 70.0),
    ("steps", 1280, 70.0),
    ("tilted", 1280, 70.0),
    ("sphere", 1280, 70.0),
    ("steps", 640, 500.0),
    ("steps", 640, 1000.0),
    ("steps", 160, 5000.0),
]
"""Scene, lit columns, laser (Hz)."""


def run(scene: str, lit: int, frequency_hz: float, seconds: float) -> tuple[float, int, int]:
    """Return thread seconds, events and bytes; with ``lit`` 0 all columns without laser."""
    calibration = replace(load_calibration("config_3"), columns=lit or 1280, principal_column=None)
    world = World(named(scene), calibration, seed=1, background_hz=BACKGROUND_HZ)
    if lit:
        world.set_laser(0, True, Modulation(frequency_hz, 0.5, "square", 0))
    world.set_stage(plan_move(0, 10.0, 210.0, 50.0, 2000.0))
    begun = time.thread_time()
    size = len(world.advance(round(seconds * 1e6)))
    return time.thread_time() - begun, world.events, size


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=0.5, help="sensor time of one run")
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    run("tilted", 8, 70.0, 0.05)
    print(
        f"{'scene':8}{'lit columns':>12}{'Hz':>7}{'Mev/s sensor':>14}"
        f"{'Mev/s CPU':>11}{'B/event':>9}{'x real time':>13}"
    )
    for case in CASES:
        results = [run(*case, options.seconds) for _ in range(options.repeats)]
        scene, lit, frequency_hz = case
        spent, events, size = min(results)
        print(
            f"{scene:8}{lit:12}{frequency_hz:7.0f}"
            f"{events / options.seconds / 1e6:14.2f}{events / spent / 1e6:11.1f}"
            f"{size / events:9.2f}{options.seconds / spent:13.1f}"
        )


if __name__ == "__main__":
    main()
