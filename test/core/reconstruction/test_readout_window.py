"""A camera that reads out a part of its rows: the window's edges are those of the sensor."""

from dataclasses import replace

import numpy as np
import pytest
from independent_pixels import FIRST_EDGE_US, Camera, Events, stream
from reconstructing import CALIBRATION, reconstruct

from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import Calibration
from eschorty_ros.core.reconstruction import Profiles
from eschorty_ros.core.storage import SENSOR_EDGE

FIRST, ROWS = 301, 120


def reconstructed(camera: Camera, events: Events, calibration: Calibration) -> Profiles:
    modulation = Modulation(camera.frequency_hz, camera.duty, on_edge_us=FIRST_EDGE_US)
    return reconstruct(stream(events), modulation, calibration=calibration)[0]


def read_out(events: Events) -> Events:
    t, x, y, p = events
    kept = (y >= FIRST) & (y < FIRST + ROWS)
    return t[kept], x[kept], y[kept], p[kept]


WINDOW = replace(CALIBRATION, roi_px=(0, FIRST, 1280, ROWS))


def test_lines_inside_the_window_are_where_they_are_without_it():
    camera = Camera(periods=6)
    events = camera.line(lambda k, c: 350.0 + 0.02 * c + 0.1 * k)
    whole, window = (reconstructed(camera, events, build) for build in (CALIBRATION, WINDOW))
    np.testing.assert_allclose(window.row, whole.row, atol=1e-9, err_msg=f"seed {camera.seed}")
    np.testing.assert_allclose(window.range_mm, whole.range_mm, rtol=1e-12)
    np.testing.assert_allclose(window.sigma_mm, whole.sigma_mm, rtol=1e-6)


@pytest.mark.parametrize("at_row", [FIRST + 1.5, FIRST + ROWS - 2.5], ids=["first", "last"])
def test_a_line_that_the_windows_first_or_last_row_cuts_is_marked_and_in_its_place(at_row):
    camera = Camera(periods=24)

    def row(k, c):
        cut = (np.asarray(c) // 160) % 2 == 0
        return np.where(cut, at_row, FIRST + 60.0) + 0.03 * np.sign(FIRST + 60.0 - at_row) * k

    events = read_out(camera.line(row))
    off = {}
    for build in (CALIBRATION, WINDOW):
        found = reconstructed(camera, events, build)
        truth = row(found.period, found.column)
        cut = (found.period >= 8) & (np.abs(truth - at_row) < 30)
        off[build.roi_px] = np.median(np.abs(found.row - truth)[cut])
        marked = np.mean((found.flags & SENSOR_EDGE > 0)[cut])
        assert marked == (build is WINDOW), f"seed {camera.seed}"
    assert off[WINDOW.roi_px] < 0.15 < 1.0 < off[None], f"seed {camera.seed}"
