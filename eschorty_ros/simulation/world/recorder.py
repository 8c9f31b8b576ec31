"""A simulated scan written as a recording, truth included; needs no ROS."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from eschorty_ros.core.base.files import atomic_files, make_folder
from eschorty_ros.core.base.progress import Progress
from eschorty_ros.core.clocks import MotionPlan, plan_move
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import Calibration, save_calibration
from eschorty_ros.core.storage import (
    CALIBRATION_FILE,
    EVENTS_FILE,
    LASER_FILE,
    STAGE_FILE,
    TRUTH_FILE,
    Recording,
    load_recording,
    write_laser_yaml,
    write_stage_csv,
    write_truth_csv,
)
from eschorty_ros.core.storage.raw_file import RawWriter
from eschorty_ros.core.storage.recording import MARKS_FILE, SCAN_FILE, SETTINGS_FILE
from eschorty_ros.simulation.pixels import PixelParameters
from eschorty_ros.simulation.scenes import Scene
from eschorty_ros.simulation.world.effects import Effects
from eschorty_ros.simulation.world.world import BACKGROUND_HZ, World

ACCELERATION_MM_S2 = 2000.0
LASER_ON_US = 50_000
LEAD_US = 50_000
"""Laser on before the stage starts and after it has stopped; dark before and after that."""

_STAGE_STEP_US = 10_000
_CHUNK_US = 100_000


def simulate_recording(
    out_dir: str | os.PathLike[str],
    scene: Scene,
    calibration: Calibration,
    modulation: Modulation | None = None,
    start_mm: float = 10.0,
    stop_mm: float = 110.0,
    speed_mm_s: float = 50.0,
    seed: int = 0,
    background_hz: float = BACKGROUND_HZ,
    parameters: PixelParameters | None = None,
    effects: Effects | None = None,
    progress: Progress | None = None,
) -> Recording:
    """Scan ``scene`` from ``start_mm`` to ``stop_mm`` and write the recording folder.

    Sensor time starts at 0 in the dark; the laser comes on at 50 ms with a rising edge, the stage
    starts 50 ms later, and both leads are repeated at the end. Returns the folder as
    :func:`load_recording` reads it.

    - ``out_dir``: Made when missing; files of an older recording in it are replaced.
    - ``modulation``: 70 Hz, duty 0.5 when left out; its ``on_edge_us`` is set here.
    - ``start_mm``, ``stop_mm``, ``speed_mm_s``: The stage's trapezoidal move at 2000 mm/s^2; it may
      run either way.
    - ``seed``: Same seed, same bytes.
    - ``background_hz``: Background events per pixel and second.
    - ``progress``: See `Progress`.

    Raises ``ArgumentError`` for a value outside its range or a folder that cannot be written.
    """
    wave = replace(modulation or Modulation(70.0), on_edge_us=LASER_ON_US)
    move = plan_move(
        (LASER_ON_US + LEAD_US) * 1000, start_mm, stop_mm, speed_mm_s, ACCELERATION_MM_S2
    )
    off_us = move.end_ns // 1000 + LEAD_US
    end_us = off_us + LEAD_US
    world = World(scene, calibration, parameters, seed, background_hz, effects=effects)
    world.set_laser(LASER_ON_US, True, wave)
    world.set_laser(off_us, False)
    # The plan rests at its first position before it starts.
    world.set_stage(MotionPlan(0, start_mm))
    world.set_stage(move, 0)
    folder = make_folder(out_dir)
    with _complete_or_absent(folder) as made:
        with RawWriter(made / EVENTS_FILE, width=world.columns, height=world.rows) as raw:
            while world.now_us < end_us:
                raw.write(world.advance(min(world.now_us + _CHUNK_US, end_us)))
                if progress is not None:
                    progress(world.now_us / end_us, "")
        # One sample past the end: the last events must be between two samples.
        t_us = np.arange(0, end_us + 2 * _STAGE_STEP_US, _STAGE_STEP_US, dtype=np.int64)
        write_stage_csv(made / STAGE_FILE, t_us, move.state(t_us * 1000)[0])
        write_laser_yaml(made / LASER_FILE, wave)
        save_calibration(calibration, made / CALIBRATION_FILE)
        truth = world.truth
        write_truth_csv(made / TRUTH_FILE, truth["t_us"], truth["column"], truth["range_mm"])
        for name in (SCAN_FILE, SETTINGS_FILE, MARKS_FILE):
            (folder / name).unlink(missing_ok=True)
    return load_recording(folder)


@contextmanager
def _complete_or_absent(folder: Path) -> Iterator[Path]:
    """Make a folder for the files; remove ``folder`` if it stays empty."""
    names = (CALIBRATION_FILE, EVENTS_FILE, STAGE_FILE, LASER_FILE, TRUTH_FILE)
    try:
        with atomic_files(folder, names) as made:
            yield made
    except BaseException:
        with suppress(OSError):
            folder.rmdir()
        raise
