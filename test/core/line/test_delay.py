"""A point's time is that of the light: rows of a moving line do not lag by the pixels' delay."""

from dataclasses import replace

import numpy as np
import pytest
from independent_pixels import FIRST_EDGE_US, Camera, stream, wavy
from reconstructing import CALIBRATION, reconstruct

from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.reconstruction import reconstruct_recording
from eschorty_ros.simulation.pixels import preset
from eschorty_ros.simulation.scenes import Plane
from eschorty_ros.simulation.world import simulate_recording

NARROW = replace(CALIBRATION, columns=128, principal_column=None)
MODEL = NARROW.model()


@pytest.mark.parametrize("duty", [0.3, 0.5])
@pytest.mark.parametrize("way_px", [0, 4])
def test_points_of_other_pixels_are_in_the_middle_of_the_light(duty, way_px):
    camera = Camera(periods=6, duty=duty, delay_us=400.0)

    def row(k, c):
        return np.rint(wavy(0, c)) + 12 * k

    events = camera.moving_line(row, way_px) if way_px else camera.line(row)
    modulation = Modulation(camera.frequency_hz, duty, on_edge_us=FIRST_EDGE_US)
    found, _ = reconstruct(stream(events), modulation)
    middle_us = 0.5 * duty * camera.period_us
    assert np.mean(found.t_us - found.edge_us) == pytest.approx(middle_us, abs=20.0)
    assert np.mean(found.row - row(found.period, found.column)) == pytest.approx(
        0.5 * way_px, abs=0.1
    )


@pytest.mark.parametrize("frequency_hz", [70.0, 1000.0])
@pytest.mark.parametrize("speed_mm_s", [300.0, -300.0])
def test_a_surface_that_slopes_along_the_stage_hardly_lags(tmp_path, frequency_hz, speed_mm_s):
    plane = Plane(1100.0, slope_stage=1.2, slope_column=0.2, pivot_mm=40.0)
    travel = (10.0, 70.0)[:: 1 if speed_mm_s > 0.0 else -1]
    recording = simulate_recording(
        tmp_path, plane, NARROW, Modulation(frequency_hz), *travel, abs(speed_mm_s),
        parameters=preset("paper"),
    )  # fmt: skip
    found = reconstruct_recording(recording).profiles
    found = found.select(np.abs(found.t_us - np.median(found.t_us)) < 60_000)
    rows = []
    for later_us in (0, 1000):
        at_us, period = np.unique(found.t_us + later_us, return_inverse=True)
        range_mm = plane.range_mm(recording.stage.position_mm(at_us), np.arange(128), MODEL)
        rows.append(MODEL.row(range_mm[period, found.column]))
    lag_ms = np.mean(rows[0] - found.row) / np.mean(rows[1] - rows[0])
    print(f"lag {lag_ms:.2f} ms")
    assert 0.0 < lag_ms < 0.55
