"""Roll and smile of the laser line, from the simulated world through the reconstruction."""

from dataclasses import replace

import numpy as np

from eschorty_ros.core.optics import load_calibration
from eschorty_ros.core.reconstruction import reconstruct_recording
from eschorty_ros.simulation.scenes import Plane
from eschorty_ros.simulation.world import simulate_recording

BENT = replace(
    load_calibration("config_3"),
    columns=96,
    principal_column=None,
    b_prime_1_px=-9.0,
    b_prime_2_px=5.0,
)


def test_a_flat_scene_stays_flat_when_the_calibration_knows_the_bend(tmp_path):
    recording = simulate_recording(
        tmp_path, Plane(1320.0), BENT, start_mm=20.0, stop_mm=30.0, speed_mm_s=50.0, seed=7
    )
    result = reconstruct_recording(recording)
    error = result.profiles.range_mm - 1320.0
    by_column = [np.median(error[result.profiles.column == c]) for c in range(96)]
    print(f"seed 7: median error of columns, largest {np.abs(by_column).max():.2f} mm")
    assert np.abs(by_column).max() < 2.0
    straight = replace(recording, calibration=replace(BENT, b_prime_1_px=0.0, b_prime_2_px=0.0))
    error = reconstruct_recording(straight).profiles.range_mm - 1320.0
    assert np.abs(error).max() > 20.0
