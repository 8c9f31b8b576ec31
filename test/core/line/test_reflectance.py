"""Relative reflectance from width and counts against the truth of a simulated line."""

from dataclasses import replace

import numpy as np
import pytest
from eschorty_experiments._line_bench import simulate_line
from reconstructing import reconstruct

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.evt3 import Encoder, sort_readout
from eschorty_ros.core.line import ROOT_12, relative_reflectance
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.core.reconstruction import Profiles, Settings, place_link
from eschorty_ros.core.storage import (
    POINT_DTYPE,
    REFLECTANCE_DTYPE,
    join_points,
    read_cloud,
    write_cloud,
)
from eschorty_ros.simulation.pixels import PixelParameters

SEED = 20261121
SIGMA_PX = 4.1


def profiles_of(frequency_hz: float, truth: np.ndarray, **settings) -> Profiles:
    """Six periods of a line whose columns have the reflectances ``truth``."""
    columns = truth.size
    modulation = Modulation(frequency_hz, on_edge_us=0)
    rng = np.random.default_rng(SEED)
    line = simulate_line(
        PixelParameters(), modulation, int(6e6 / frequency_hz), columns=columns,
        line_row=360.0 + rng.random(columns), reflectance=truth, seed=SEED,
    )  # fmt: skip
    data = Encoder(columns, 720).encode(*sort_readout(line.t, line.x, line.y, line.p))
    calibration = replace(load_calibration("config_3"), columns=columns)
    wanted = Settings(smoothing_half_width=0, isolation_events=0, **settings)
    found, _ = reconstruct(data, modulation, wanted, calibration=calibration)
    return found.select(found.period >= 2)


def mixed(columns: int = 512) -> np.ndarray:
    """Log-uniform from 0.07, a little above what the sensor still sees, to 1."""
    return np.exp(np.random.default_rng(SEED).uniform(np.log(0.07), 0.0, columns))


@pytest.mark.parametrize("frequency_hz", [70.0, 300.0, 1000.0])
def test_reflectance_against_a_white_target(frequency_hz):
    # Gated, as late events widen the line; a gate this long is none at 1 kHz.
    white = profiles_of(frequency_hz, np.ones(512), phase_gate_us=1000)
    truth = mixed()
    white_width_px = float(np.median(white.width_px))
    found = profiles_of(
        frequency_hz, truth, reflectance="on", white_width_px=white_width_px, phase_gate_us=1000
    )
    true = truth[found.column]
    error = np.log(found.reflectance / true)
    for low, high in ((0.07, 0.2), (0.2, 0.5), (0.5, 1.0)):
        part = (true >= low) & (true < high)
        assert abs(np.median(error[part])) < 0.15, f"seed {SEED}: {low} {np.median(error[part])}"
    pull = error / (found.reflectance_sigma / found.reflectance)
    within = [float(np.mean(np.abs(pull) < k)) for k in (1.0, 2.0)]
    assert 0.6 < within[0] < 0.8, f"seed {SEED}: {within}"
    assert within[1] > 0.88, f"seed {SEED}: {within}"


def test_median_of_the_profile_is_the_reference_by_default():
    found = profiles_of(70.0, mixed(), reflectance="on")
    for edge in np.unique(found.edge_us):
        assert np.median(found.reflectance[found.edge_us == edge]) == pytest.approx(1.0, rel=0.02)


def test_even_rows_follow_the_closed_form():
    full_px = np.array([10.0, 14.0, 20.0, 20.0])
    edge = np.array([0, 0, 0, 7])
    seen = edge, full_px / ROOT_12, (2 * full_px).astype(np.uint32), SIGMA_PX
    rho, sigma = relative_reflectance(*seen)
    log = (full_px[:3] ** 2 - 14.0**2) / (8 * SIGMA_PX**2)
    np.testing.assert_allclose(rho[:3], np.exp(log), rtol=1e-12)
    assert rho[3] == 1.0
    assert (sigma > 0).all()
    rho, _ = relative_reflectance(*seen, 20.0 / ROOT_12)
    assert rho[2:] == pytest.approx([1.0, 1.0])


def test_points_without_spread_no_points_and_unequal_lengths():
    none = np.zeros(3)
    rho, sigma = relative_reflectance(np.zeros(3, int), none, np.ones(3, np.uint32), SIGMA_PX)
    assert np.isfinite(rho).all()
    assert np.isfinite(sigma).all()
    empty = np.empty(0)
    rho, _ = relative_reflectance(np.empty(0, int), empty, np.empty(0, np.uint32), SIGMA_PX)
    assert rho.size == 0
    with pytest.raises(ArgumentError, match="edge_us has 2 entries"):
        relative_reflectance(np.zeros(2, int), none, np.ones(3, np.uint32), 1.0)


def test_spread_over_background_has_no_reflectance():
    edge_us, events = np.zeros(3, int), np.full(3, 60, np.uint32)
    width_px = np.array([6.0, 6.0, 200.0])
    rho, sigma = relative_reflectance(edge_us, width_px, events * [1, 1, 50], SIGMA_PX)
    np.testing.assert_allclose(rho[:2], 1.0, rtol=1e-12)
    assert np.isnan([rho[2], sigma[2]]).all()


@pytest.mark.parametrize("extension", [".pcd", ".ply"])
def test_cloud_carries_reflectance_only_when_asked(tmp_path, extension):
    model = load_calibration("config_3").model()
    plain = place_link(profiles_of(70.0, np.ones(16)), model)
    assert plain.dtype == POINT_DTYPE
    found = profiles_of(70.0, np.ones(16), reflectance="on")
    points = place_link(found, model)
    assert points.dtype == REFLECTANCE_DTYPE
    file = tmp_path / f"cloud{extension}"
    write_cloud(file, points)
    np.testing.assert_array_equal(read_cloud(file), points)
    np.testing.assert_array_equal(points["reflectance"], found.reflectance.astype(np.float32))
    both = join_points([plain, points])
    assert np.isnan(both["reflectance"][: len(plain)]).all()
    np.testing.assert_array_equal(both["x"][len(plain) :], points["x"])


def test_profiles_with_and_without_reflectance_join():
    plain = profiles_of(70.0, np.ones(16))
    known = profiles_of(70.0, np.ones(16), reflectance="on")
    both = Profiles.concatenate([plain, known])
    assert np.isnan(both.reflectance[: len(plain)]).all()
    np.testing.assert_array_equal(both.reflectance[len(plain) :], known.reflectance)
    assert plain.select(slice(0, 3)).reflectance is None
