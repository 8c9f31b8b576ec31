"""Reflectance steps that cross the line: shift with and without compensation."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from eschorty_experiments._crossing import SPEED_MM_S, Crossing, crossing
from from_python import from_python
from independent_pixels import FIRST_EDGE_US, Camera, stream, wavy
from reconstructing import assert_same, reconstruct

from eschorty_ros.core.clocks import StageTrack
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.core.reconstruction import (
    Reconstructor,
    Settings,
    reconstruct_recording,
    stage_speed_mm_s,
)
from eschorty_ros.core.reconstruction.step_compensation import _centroid_shift
from eschorty_ros.core.storage import ScanLog
from eschorty_ros.simulation.pixels import PixelParameters
from eschorty_ros.simulation.scenes import Plane
from eschorty_ros.simulation.world import simulate_recording

SEED = 20261121
PARAMETERS = PixelParameters()
# Profiles at either end of a stream whose neighbours are not in it.
EDGE_ROWS = 14.0


def errors(case: Crossing, **settings):
    """Error of every point on the target whose neighbours are known, and the step's offset."""
    found, counts = case.reconstruct(**settings)
    offset = case.offset_rows[found.period, found.column]
    inside = case.target[found.column] & (np.abs(offset) < EDGE_ROWS)
    error = found.row - case.line_row[found.column]
    return error[inside], offset[inside], counts


def shift_over_offset(error, offset):
    """Mean error in bins of two rows of the step's offset, the largest in size."""
    place = np.floor(offset / 2.0).astype(int)
    return max(abs(float(error[place == k].mean())) for k in np.unique(place))


@pytest.mark.parametrize("frequency_hz", [70.0, 1000.0])
@pytest.mark.parametrize(("before", "after"), [(0.08, 1.0), (1.0, 0.08), (0.04, 0.8)])
def test_shift_at_a_step_is_more_than_halved(frequency_hz, before, after):
    # A step visits each row of offset once in a column: many columns at 70 Hz, few at 1 kHz.
    columns = 160 if frequency_hz < 100.0 else 40
    case = crossing(
        PARAMETERS, frequency_hz, before, after, columns=columns, slanted=True, seed=SEED
    )
    off = errors(case, reflectance_compensation="off")
    on = errors(case, reflectance_compensation="on")
    assert off[2]["columns_compensated"] == 0
    assert on[2]["columns_compensated"] > 0
    left = shift_over_offset(on[0], on[1]) / shift_over_offset(off[0], off[1])
    assert left < 0.5, f"seed {SEED}: {left}"
    assert np.sqrt(np.mean(on[0] ** 2)) < 0.4 * np.sqrt(np.mean(off[0] ** 2)), f"seed {SEED}"


@pytest.mark.parametrize("frequency_hz", [70.0, 1000.0])
@pytest.mark.parametrize("reflectance", [0.1, 0.4, 1.0])
def test_uniform_targets_stay_as_they_are(frequency_hz, reflectance):
    case = crossing(
        PARAMETERS, frequency_hz, reflectance, reflectance, columns=40, background_hz=0.2, seed=SEED
    )
    off, _ = case.reconstruct(reflectance_compensation="off")
    on, counts = case.reconstruct(reflectance_compensation="on")
    change = np.abs(on.row - off.row)
    assert np.sqrt(np.mean(change**2)) < 0.1, f"seed {SEED}"
    assert counts["columns_compensated"] < 0.005 * len(on), f"seed {SEED}"


def test_the_direction_of_the_surface_is_seen_in_the_rows():
    case = crossing(PARAMETERS, 1000.0, 0.1, 1.0, columns=16, seed=SEED)
    right = errors(case, reflectance_compensation="on")[0]
    wrong = errors(case, reflectance_compensation="on", stage_speed_mm_s=-SPEED_MM_S)[0]
    none = errors(case, reflectance_compensation="off")[0]
    rms = [float(np.sqrt(np.mean(e**2))) for e in (right, none, wrong)]
    assert rms[0] < 0.5 * rms[1], f"seed {SEED}: {rms}"
    assert rms[2] < 0.5 * rms[1], f"seed {SEED}: {rms}"


@pytest.mark.parametrize(
    "profile",
    [lambda k: k % 30 - 15, lambda k: 15 - k % 30, lambda k: 15 - abs(k - 30)],
    ids=["towards +y", "towards -y", "the stage turns"],
)
def test_steps_of_other_pixels_are_corrected_however_the_camera_is_mounted(profile):
    camera = Camera(periods=60, contrast=40.0)

    def edge(k):
        """Return where the step is in the line, rows from its centre."""
        return 1.6 * profile(k)

    dark = camera.line(wavy, 0.08, lambda k, _: (-30.0, edge(k)))
    bright = camera.line(wavy, 1.0, lambda k, _: (edge(k), 30.0))
    modulation = Modulation(70.0, on_edge_us=FIRST_EDGE_US)
    rms = {}
    for switch in ("off", "on"):
        settings = Settings(reflectance_compensation=switch, stage_speed_mm_s=30.0)
        found, _ = reconstruct(stream(dark, bright), modulation, settings)
        error = found.row - wavy(found.period, found.column.astype(float))
        inner = (found.period > 3) & (found.period < 56)
        rms[switch] = float(np.sqrt(np.mean(error[inner] ** 2)))
    print(f"seed {camera.seed}: {rms}")
    assert rms["on"] < 0.75 * rms["off"], f"seed {camera.seed}: {rms}"


def test_a_resting_stage_has_no_steps_to_compensate():
    case = crossing(PARAMETERS, 70.0, 0.1, 1.0, columns=16, seed=SEED)
    off, _ = case.reconstruct(reflectance_compensation="off")
    on, counts = case.reconstruct(reflectance_compensation="on", stage_speed_mm_s=0.0)
    np.testing.assert_array_equal(on.row, off.row)
    assert counts["columns_compensated"] == 0


def test_a_compensation_without_a_speed_is_a_warning():
    made = Reconstructor(
        load_calibration("config_3"), Modulation(70.0), Settings(reflectance_compensation="on")
    )
    assert "set stage_speed_mm_s" in "\n".join(made.warnings)
    made.set_stage_speed(50.0)
    assert "set stage_speed_mm_s" not in "\n".join(made.warnings)


@pytest.mark.parametrize("bend", [{"b_prime_1_px": 8.0}, {"b_prime_2_px": -8.0}], ids=str)
def test_a_compensated_row_becomes_a_range_in_its_own_column(bend):
    case = crossing(PARAMETERS, 1000.0, 0.1, 1.0, columns=40, slanted=True, seed=SEED)
    middle = (case.calibration.columns - 1) / 2
    calibration = replace(case.calibration, **{"principal_column": middle, **bend})
    model = calibration.model()
    off, _ = replace(case, calibration=calibration).reconstruct(reflectance_compensation="off")
    on, _ = replace(case, calibration=calibration).reconstruct(reflectance_compensation="on")
    moved = on.row != off.row
    assert moved.sum() > 500, f"seed {SEED}"
    error_mm = on.range_mm - model.range_mm(case.line_row[on.column], on.column)
    left_mm = np.abs(error_mm[moved]).max()
    assert left_mm < 5.0, f"seed {SEED}: {left_mm} mm"
    np.testing.assert_array_equal(on.range_mm, model.range_mm(on.row, on.column))
    sigma_mm = model.range_sigma_mm(on.row, on.sigma_row, on.column)
    np.testing.assert_array_equal(on.sigma_mm, sigma_mm)


def test_points_do_not_depend_on_how_the_bytes_are_split():
    case = crossing(PARAMETERS, 1000.0, 0.1, 1.0, columns=16, seed=SEED)
    whole, counts = case.reconstruct(reflectance_compensation="on")
    settings = Settings(reflectance_compensation="on", stage_speed_mm_s=SPEED_MM_S)
    stream = case.data, case.modulation, settings
    for size in (1000, 7777):
        cuts = range(size, len(case.data), size)
        parts, reconstructor = reconstruct(*stream, cuts, case.calibration)
        assert_same(parts, whole)
        assert reconstructor.counters == counts


def test_no_profile_is_lost_or_doubled_and_a_new_modulation_lets_all_out():
    case = crossing(PARAMETERS, 1000.0, 0.5, 0.5, columns=8, seed=SEED)
    off, _ = case.reconstruct(reflectance_compensation="off")
    on, _ = case.reconstruct(reflectance_compensation="on")
    np.testing.assert_array_equal(on.period, off.period)
    np.testing.assert_array_equal(on.column, off.column)
    settings = Settings(reflectance_compensation="on", stage_speed_mm_s=SPEED_MM_S)
    reconstructor = Reconstructor(case.calibration, case.modulation, settings)
    half = len(case.data) // 2
    parts = [reconstructor.push(case.data[:half])]
    reconstructor.set_modulation(Modulation(500.0, on_edge_us=0))
    parts += [reconstructor.push(case.data[half:]), reconstructor.flush()]
    assert reconstructor.counters["points"] == sum(len(part) for part in parts)


@pytest.mark.parametrize(("low", "high"), [(0.0, 20.0), (6.0, 20.0), (14.0, 20.0)])
def test_shift_agrees_with_lit_rows_counted(low, high):
    """Rows lit on either side of a step at every offset, against the centroid's closed form."""
    half_low, half_high = low / 2, high / 2
    y = np.arange(-15.0, 15.0, 0.01) + 0.005
    centroid_shift = from_python(_centroid_shift)
    for offset in np.arange(-12.0, 12.0, 0.5):
        wide = y < offset
        lit = np.where(wide, np.abs(y) < half_high, np.abs(y) < half_low)
        if not lit.any():
            continue
        width, centre = lit.sum() * 0.01, y[lit].mean()
        # The new surface, at low rows, is the wider one: the centroid moves down.
        assert -centroid_shift(low, width, high) == pytest.approx(centre, abs=0.02)
        assert centroid_shift(high, width, low) == pytest.approx(centre, abs=0.02)


@pytest.mark.parametrize(("before", "after"), [(0.04, 1.0), (1.0, 0.1), (0.2, 0.8)])
def test_sigma_of_corrected_points_is_honest(before, after):
    case = crossing(PARAMETERS, 1000.0, before, after, columns=60, slanted=True, seed=SEED)
    off, _ = case.reconstruct(reflectance_compensation="off", smoothing_half_width=0)
    on, _ = case.reconstruct(reflectance_compensation="on", smoothing_half_width=0)
    moved = (on.row != off.row) & (np.abs(case.offset_rows[on.period, on.column]) < EDGE_ROWS)
    pull = np.abs((on.row - case.line_row[on.column]) / on.sigma_row)[moved]
    within = [float(np.mean(pull < k)) for k in (1.0, 2.0)]
    assert 0.55 < within[0] < 0.85, f"seed {SEED}: {within}"
    assert within[1] > 0.85, f"seed {SEED}: {within}"


class Striped(Plane):
    """Plane with slanted stripes, 15 mm wide, black and white."""

    def reflectance(self, stage_mm, columns, model):
        y = np.asarray(stage_mm)[:, None] + 0.05 * np.asarray(columns)
        return np.where((y // 15.0) % 2 == 0, 0.08, 1.0)


@pytest.mark.parametrize("frequency_hz", [70.0, 1000.0])
@pytest.mark.parametrize(("start_mm", "stop_mm"), [(10.0, 70.0), (70.0, 10.0)])
def test_recording_of_a_striped_plane_either_way(tmp_path, frequency_hz, start_mm, stop_mm):
    calibration = replace(load_calibration("config_3"), columns=64)
    recording = simulate_recording(
        tmp_path, Striped(1320.0), calibration, Modulation(frequency_hz), start_mm, stop_mm,
        200.0, SEED,
    )  # fmt: skip
    # A third of the way is cruise.
    speed = stage_speed_mm_s(recording)
    assert speed == pytest.approx(np.copysign(200.0, stop_mm - start_mm), rel=0.02)
    rms = {}
    for choice in ("off", "on"):
        result = reconstruct_recording(recording, Settings(reflectance_compensation=choice))
        inside = (result.points["y"] > 0.02) & (result.points["y"] < 0.06)
        error = result.profiles.row[inside] - calibration.model().row(1320.0)
        rms[choice] = float(np.sqrt(np.mean(error**2)))
    # What is left holds the rows' own scatter, some 0.3 px.
    left = np.sqrt(max(rms["on"] ** 2 - 0.3**2, 0.0)) / np.sqrt(rms["off"] ** 2 - 0.3**2)
    assert left < 0.3, f"seed {SEED}: {rms}"


def test_the_speed_of_a_stage_that_goes_forth_and_back_is_that_of_one_pass():
    stage = StageTrack()
    t_us = np.arange(0, 2_200_001, 10_000)
    stage.append(t_us, np.interp(t_us, [0, 1_000_000, 1_100_000, 2_100_000], [10, 60, 60, 10]))
    recording = SimpleNamespace(stage=stage, scan=None, calibration=load_calibration("config_3"))
    assert stage_speed_mm_s(recording) == pytest.approx(50.0, rel=0.01)
    # That of a scan is the one that its live points were made with.
    recording.scan = ScanLog(scan_id="s", start_mm=60.0, stop_mm=10.0, speed_mm_s=49.0)
    assert stage_speed_mm_s(recording) == -49.0


def test_a_stage_with_gaps_alone_has_no_speed():
    stage = StageTrack(max_gap_us=1_000_000)
    stage.append(np.array([0, 10_000_000]), np.array([10.0, 60.0]))
    recording = SimpleNamespace(stage=stage, scan=None, calibration=load_calibration("config_3"))
    assert stage_speed_mm_s(recording) == 0.0
