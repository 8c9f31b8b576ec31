"""Errors of a scan, and the leaf levels' distance, from clouds whose errors are known."""

from dataclasses import replace

import numpy as np
import pytest
from eschorty_experiments._leaf_levels import level_residuals, level_steps
from eschorty_experiments._scan_errors import GROSS_PX, scan_errors

from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.core.reconstruction import Profiles, Result, reconstruct_recording
from eschorty_ros.core.storage import POINT_DTYPE
from eschorty_ros.simulation.scenes import SEPARATION_MM, Leaves, Plane
from eschorty_ros.simulation.world import simulate_recording

SEED = 5
MODEL = load_calibration("config_3").model()


def narrow(columns=64):
    return replace(load_calibration("config_3"), columns=columns, principal_column=None)


def test_errors_gross_errors_and_gaps_are_told_apart(tmp_path):
    scene = Plane(1320.0)
    recording = simulate_recording(
        tmp_path, scene, narrow(), Modulation(200.0), 10.0, 12.0, 50.0, SEED, 0.0
    )
    profiles = reconstruct_recording(recording).profiles
    errors = scan_errors(profiles, recording, scene)
    assert (errors.completeness, errors.gross_share) == (1.0, 0.0)
    assert errors.rmse_mm < 1.0
    np.testing.assert_allclose(errors.error_mm, profiles.range_mm - 1320.0, atol=1e-9)
    # Move every tenth point away and leave every fourth period out.
    model = recording.calibration.model()
    row = profiles.row.copy()
    row[::10] += GROSS_PX + 2.0
    moved = replace(profiles, row=row, range_mm=model.range_mm(row))
    kept = moved.select(moved.period % 4 != 0)
    changed = scan_errors(kept, recording, scene)
    assert changed.gross_share == pytest.approx(0.1, abs=0.01)
    assert changed.completeness == pytest.approx(0.75, abs=0.04)
    assert changed.rmse_mm > 5.0
    assert changed.median_mm < 1.0
    none = scan_errors(profiles.select(slice(0, 0)), recording, scene)
    assert none.completeness == 0.0
    assert np.isnan([none.rmse_mm, none.gross_share]).all()


def test_the_leaf_levels_of_the_truth_are_2_2_mm_apart():
    leaves = Leaves()
    rng = np.random.default_rng(SEED)
    pitch_mm, columns = 2.0, np.arange(1280)
    stage = np.arange(0.0, 200.0, pitch_mm)
    truth = leaves.range_mm(stage, columns, MODEL)
    line, column = np.nonzero(np.isfinite(truth))
    noise_mm = rng.normal(0.0, 0.5, line.size)
    points = np.zeros(line.size, POINT_DTYPE)
    points["x"] = (truth[line, column] + noise_mm) * 1e-3
    points["y"], points["t"], points["column"] = stage[line] * 1e-3, line / 150.0, column
    result = Result(points, Profiles.empty(), {}, stage.size, 1, 0, 0.0, ())
    steps = level_steps(level_residuals(leaves, result, MODEL, pitch_mm))
    assert [(step.near, step.far) for step in steps] == [(0, 1), (1, 2)]
    for step in steps:
        assert step.points > 500
        assert step.step_mm == pytest.approx(SEPARATION_MM, abs=0.08), f"seed {SEED}"
        assert step.scatter_mm == pytest.approx(0.5, abs=0.03)
        assert step.d_prime == pytest.approx(step.step_mm / step.scatter_mm)


def test_levels_without_points_are_nan():
    steps = level_steps(np.array([[0.0, 0.1], [0.0, -0.1]]))
    assert all(np.isnan(step.step_mm) and step.points == 0 for step in steps)
