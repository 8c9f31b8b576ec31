"""Lag of the points of scans back and forth, and what is left of it."""

from dataclasses import replace

import numpy as np
import pytest
from independent_pixels import FIRST_EDGE_US, Camera, stream
from reconstructing import CALIBRATION

from eschorty_ros.core.clocks import StageTrack
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import save_calibration
from eschorty_ros.core.reconstruction import (
    add_stage,
    pass_lag,
    reconstruct_recording,
    recorded_settings,
    take_off_lag,
)
from eschorty_ros.core.storage import (
    POINT_DTYPE,
    load_recording,
    write_laser_yaml,
    write_stage_csv,
)
from eschorty_ros.report.accuracy import stage_and_range_mm

SPEED_MM_US = 300e-6
PROFILES = 60
COLUMNS = np.arange(0, 1280)


def track(turn_us: int, passes: int) -> StageTrack:
    """Return a stage that goes forth, and back with two passes; known before and after as well."""
    t_us = np.arange(-100_000, 2 * turn_us + 100_001, 1000)
    way = np.abs(turn_us - t_us) if passes == 2 else turn_us - t_us
    stage = StageTrack()
    stage.append(t_us, 200.0 + SPEED_MM_US * (turn_us - way))
    return stage


def surface_mm(stage_mm, column):
    return 1300.0 + 8.0 * np.sin(stage_mm / 12.0) + 5.0 * np.sin(stage_mm / 30.0 + column / 200.0)


def step_mm(stage_mm, column):
    """Return a surface with an edge of 40 mm across its middle."""
    return surface_mm(stage_mm, column) + 40.0 * (stage_mm > 310.0)


def flat_mm(stage_mm, column):
    return 1300.0 + 0.0 * stage_mm


def blurred_step_mm(stage_mm, column):
    """Return a step of 2 mm as a line of some millimetres shows it, a slope of 7 mm."""
    return 1300.0 + np.clip((stage_mm - 310.0) / 3.5, -1.0, 1.0)


def scan(lag_us, passes=2, surface=surface_mm, origin_us=5_000_000, direction=(0.0, 1.0, 0.0)):
    """Return points that show the surface of ``lag_us`` ago, with the stage and their ranges."""
    period_us = 14_000
    stage = track(PROFILES * period_us, passes)
    t_us = np.repeat(np.arange(2 * PROFILES) * period_us, COLUMNS.size)
    column = np.tile(COLUMNS, 2 * PROFILES)
    seen_mm = surface(stage.position_mm(t_us - round(lag_us)), column)
    points = np.zeros(t_us.size, POINT_DTYPE)
    points["x"] = (seen_mm + np.random.default_rng(3).normal(0.0, 0.2, t_us.size)) * 1e-3
    points["t"], points["column"] = (t_us - origin_us) * 1e-6, column
    add_stage(points, stage.position_mm(t_us), direction)
    return points, origin_us, stage, direction


@pytest.mark.parametrize("surface", [surface_mm, step_mm])
@pytest.mark.parametrize("lag_us", [-2600.0, 400.0, 6000.0])
@pytest.mark.parametrize("direction", [(0.0, 1.0, 0.0), (0.28, 0.96, 0.0)])
def test_the_lag_of_two_passes_is_found_and_taken_off(lag_us, surface, direction):
    points, origin_us, stage, _ = scan(lag_us, surface=surface, direction=direction)
    found = pass_lag(points, origin_us, stage, direction)
    assert found.lag_us == pytest.approx(lag_us, rel=0.02, abs=4.0 * found.sigma_us)
    assert found.sigma_us < 30.0
    t_s = points["t"].copy()
    take_off_lag(points, origin_us, stage, direction, found.lag_us)
    np.testing.assert_allclose(t_s - points["t"], found.lag_us * 1e-6, atol=1e-6)
    stage_mm, range_mm = stage_and_range_mm(points, direction)
    error_mm = range_mm - surface(stage_mm, points["column"])
    assert abs(np.median(error_mm)) < 0.02, "seed 3"
    assert np.quantile(np.abs(error_mm), 0.6827) < 0.23
    left = pass_lag(points, origin_us, stage, direction)
    assert left is None or abs(left.lag_us) < 50.0


@pytest.mark.parametrize(
    "options",
    [{"passes": 1}, {"surface": flat_mm}, {"surface": blurred_step_mm}, {"lag_us": 0.0}],
    ids=["one pass", "no slope", "a step", "no lag"],
)
def test_a_lag_that_nothing_shows_is_none(options):
    assert pass_lag(*scan(**{"lag_us": 2000.0, **options})) is None
    points, *where = scan(2000.0)
    assert pass_lag(points[:0], *where) is None


@pytest.mark.parametrize("organized", ["off", "on"])
def test_a_recording_forth_and_back_is_less_its_lag(organized, tmp_path):
    camera, lag_us = Camera(periods=2 * 40), 3000.0
    model, stage = CALIBRATION.model(), track(round(40 * 1e6 / 70.0), 2)

    def row(k, column):
        # In the middle of the light.
        t_us = FIRST_EDGE_US + (k + 0.25) * camera.period_us - lag_us
        return model.row(surface_mm(stage.position_mm(round(t_us)), column))

    camera_modulation = Modulation(70.0, on_edge_us=FIRST_EDGE_US)
    (tmp_path / "events.raw").write_bytes(b"% evt 3.0\n% end\n" + stream(camera.line(row)))
    write_laser_yaml(tmp_path / "laser.yaml", camera_modulation)
    save_calibration(CALIBRATION, tmp_path / "calibration.yaml")
    t_us = np.arange(0, round(camera.end_us) + 50_000, 1000)
    write_stage_csv(tmp_path / "stage.csv", t_us, stage.position_mm(t_us))
    settings = recorded_settings(load_recording(tmp_path))
    found = reconstruct_recording(load_recording(tmp_path), replace(settings, organized=organized))
    assert found.pass_lag.lag_us == pytest.approx(lag_us, abs=150.0)
    clouds = [found.points] if organized == "off" else [found.points, found.organized.ravel()]
    for points in clouds:
        error_mm = 1e3 * points["x"] - surface_mm(1e3 * points["y"], points["column"])
        assert abs(np.nanmedian(error_mm)) < 0.03, f"seed {camera.seed}"
        assert np.nanquantile(np.abs(error_mm), 0.6827) < 0.3
    assert found.profiles.t_us[0] - round(1e6 * found.points["t"][0]) == pytest.approx(
        FIRST_EDGE_US, abs=200
    )
