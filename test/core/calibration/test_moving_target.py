"""A target that the stage moves along the range: every profile is one more known range."""

from dataclasses import replace

import numpy as np
import pytest

from eschorty_ros.core.base.errors import ArgumentError, FitError
from eschorty_ros.core.calibration import Targets, fit, moving_target
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.core.reconstruction import Profiles, reconstruct_recording
from eschorty_ros.simulation.scenes import Plane
from eschorty_ros.simulation.world import simulate_recording

NOMINAL = replace(load_calibration("config_3"), columns=48, principal_column=None)
CHANGED = {"k_prime_px": 0.96 * NOMINAL.k_prime_px, "b_prime_px": -1102.74}
AS_BUILT = replace(NOMINAL, **CHANGED)
SPEED_MM_S = 100.0


@pytest.fixture(scope="module")
def sweeps(tmp_path_factory) -> list[tuple[float, Profiles, np.ndarray]]:
    """Profiles of a plane that the stage moves, standing at two places, back and forth at each."""
    made = []
    for at_zero_mm in (850.0, 1800.0):
        for start_mm, stop_mm in ((10.0, 210.0), (210.0, 10.0)):
            recording = simulate_recording(
                tmp_path_factory.mktemp("sweep"), Plane(at_zero_mm, slope_stage=1.0), AS_BUILT,
                start_mm=start_mm, stop_mm=stop_mm, speed_mm_s=SPEED_MM_S, seed=len(made),
            )  # fmt: skip
            profiles = reconstruct_recording(recording).profiles
            made.append((at_zero_mm, profiles, recording.stage.position_mm(profiles.t_us)))
    return made


def test_sweeps_forth_and_back_give_the_geometry(sweeps):
    parts = [moving_target(profiles, stage, zero) for zero, profiles, stage in sweeps]
    assert all(len(part) > 0.95 * 200.0 / SPEED_MM_S * 70.0 for part in parts)
    nominal, true = NOMINAL.model(), AS_BUILT.model()
    true_mm = np.linspace(800.0, 2100.0, 131)

    def rms_mm(targets: Targets) -> float:
        rows = Targets(targets.row, targets.range_mm, targets.sigma_row_px)
        error = fit(rows, nominal).model.range_mm(true.row(true_mm)) - true_mm
        return float(np.sqrt(np.mean(error**2)))

    both = Targets.concatenate(parts)
    pulls = (both.row - true.row(both.range_mm)) / both.sigma_row_px
    forth, back = (Targets.concatenate(parts[k::2]) for k in (0, 1))
    print(f"{len(both)} targets, pulls {pulls.mean():+.2f} +- {pulls.std():.2f}; range RMS "
          f"{rms_mm(both):.3f} mm, {rms_mm(forth):.3f} forth, {rms_mm(back):.3f} back")  # fmt: skip
    assert rms_mm(both) < 0.2
    # A line that moves over the pixels is seen late: half of the difference of the directions.
    assert rms_mm(both) < 0.5 * min(rms_mm(forth), rms_mm(back))
    # On this slope the line is thinner, and the rows nearer, than on a target that moves.
    assert 0.4 < pulls.std() < 1.5


def test_blocks_lie_side_by_side(sweeps):
    zero, profiles, stage = sweeps[0]
    one = moving_target(profiles, stage, zero)
    parts = moving_target(profiles, stage, zero, blocks=4)
    assert len(parts) == pytest.approx(4 * len(one), rel=0.02)
    assert set(np.round(parts.column / 12.0 - 0.48).astype(int)) == {0, 1, 2, 3}
    # They share the line's lag and the pixels' grid: more of them add nothing about the range.
    sigmas = [fit(targets, NOMINAL.model()).range_sigma_mm(950.0) for targets in (one, parts)]
    assert sigmas[1] == pytest.approx(sigmas[0], rel=0.2)


def test_a_stage_that_moves_the_target_nearer_gives_the_same_ranges(sweeps):
    zero, profiles, stage = sweeps[0]
    away = moving_target(profiles, stage, zero)
    nearer = moving_target(profiles, 220.0 - stage, zero + 220.0, range_per_stage=-1.0)
    np.testing.assert_allclose(nearer.range_mm, away.range_mm, atol=1e-9)


def test_profiles_off_the_others_are_left_out(sweeps):
    zero, profiles, stage = sweeps[0]
    good = moving_target(profiles, stage, zero)
    edges = np.unique(profiles.edge_us)[[3, 40, 41, 90]]
    wrong = np.where(np.isin(profiles.edge_us, edges), stage + 12.0, stage)
    kept = moving_target(profiles, wrong, zero)
    assert len(kept) == len(good) - len(edges)
    assert set(kept.row.tolist()) <= set(good.row.tolist())


def test_points_without_a_stage_position_are_left_out(sweeps):
    zero, profiles, stage = sweeps[0]
    half = np.where(stage < 100.0, np.nan, stage)
    assert moving_target(profiles, half, zero).range_mm.min() > zero + 99.0


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"stage_mm": np.zeros(3)}, ArgumentError, "one position for each"),
        ({"range_at_zero_mm": -500.0}, ArgumentError, "at or behind the datum"),
        ({"blocks": 30}, FitError, "too few for 30"),
    ],
)
def test_impossible_requests_are_refused(sweeps, change, error, words):
    zero, profiles, stage = sweeps[0]
    given = {"stage_mm": stage, "range_at_zero_mm": zero, **change}
    with pytest.raises(error, match=words):
        moving_target(profiles, **given)


def test_nothing_seen_is_refused():
    with pytest.raises(FitError, match="half of the profiles"):
        moving_target(Profiles.empty(), np.empty(0), 1000.0)
