"""Phase gate: what it keeps of a simulated line, what it leaves of the background, its counts."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from line_events import encoded
from reconstructing import reconstruct

from eschorty_ros.core.evt3 import Decoder
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.modulation.phase_gate import (
    GATE_LEARNED,
    GATE_MAX_US,
    LEAD_US,
    phase_gate,
)
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.core.reconstruction import Settings, reconstruct_recording
from eschorty_ros.core.storage.raw_file import RawReader
from eschorty_ros.report.accuracy import true_range_mm
from eschorty_ros.simulation.pixels import preset
from eschorty_ros.simulation.scenes import Plane, named
from eschorty_ros.simulation.world import World, simulate_recording

SEED = 20261121
COLUMNS = 128
CALIBRATION = replace(load_calibration("config_3"), columns=COLUMNS)
EDGE_US = 3_217


def line(frequency_hz: float, duty: float = 0.5, periods: int = 24):
    """Noiseless line on a plane: every event is signal."""
    world = World(Plane(1320.0), CALIBRATION, seed=SEED, background_hz=0.0)
    world.set_laser(0, True, Modulation(frequency_hz, duty, on_edge_us=EDGE_US))
    data = world.advance(EDGE_US + round(periods * 1e6 / frequency_hz))
    events = Decoder(COLUMNS, CALIBRATION.rows).decode(data)
    return events.t, events.x, events.y, events.p


def background(rate_hz: float, until_us: int, seed: int = SEED):
    rng = np.random.default_rng(seed)
    size = rng.poisson(rate_hz * 1e-6 * until_us * COLUMNS * CALIBRATION.rows)
    t = np.sort(rng.integers(EDGE_US, until_us, size))
    x = rng.integers(0, COLUMNS, size).astype(np.uint16)
    y = rng.integers(0, CALIBRATION.rows, size).astype(np.uint16)
    return t, x, y, rng.integers(0, 2, size).astype(np.uint8)


def stream(parts, triggers_us=None) -> bytes:
    t, x, y, p = (np.concatenate(values) for values in zip(*parts, strict=True))
    order = np.lexsort((x, p, y, t))
    return encoded((t[order], x[order], y[order], p[order]), triggers_us)


def run(data: bytes, modulation: Modulation, gate_us: int, **settings: int):
    chosen = Settings(phase_gate_us=gate_us, **settings)
    found, reconstructor = reconstruct(data, modulation, chosen, calibration=CALIBRATION)
    return found, reconstructor.counters


def phases(kind: str, frequency_hz: float, duty: float, until_us: int):
    """Modulation and triggers for an edge that is known, triggered or to be estimated."""
    modulation = Modulation(frequency_hz, duty)
    if kind == "known":
        return replace(modulation, on_edge_us=EDGE_US), None
    if kind == "estimated":
        return modulation, None
    count = int((until_us - EDGE_US) * 1e-6 * frequency_hz) + 1
    known = replace(modulation, on_edge_us=EDGE_US)
    return modulation, np.array([known.edge_us(k) for k in range(count)])


@pytest.mark.parametrize("kind", ["known", "trigger", "estimated"])
@pytest.mark.parametrize(
    ("frequency_hz", "duty", "gate_us", "cut"),
    [(70.0, 0.5, 1000, 10.0), (70.0, 0.2, 1000, 10.0), (300.0, 0.5, 600, 4.0)],
)
def test_signal_stays_and_background_goes(kind, frequency_hz, duty, gate_us, cut):
    signal = line(frequency_hz, duty)
    end_us = int(signal[0][-1])
    noise_part = background(2.0, end_us)
    modulation, triggers = phases(kind, frequency_hz, duty, end_us)
    _, both = run(stream([signal, noise_part], triggers), modulation, gate_us)
    seen = both["events"] - both["events_outside_phase"]
    # The phase is known here, so that signal and noise can be distinguished.
    exact = replace(modulation, on_edge_us=EDGE_US)
    _, quiet = run(stream([signal]), exact, gate_us)
    _, noise = run(stream([noise_part]), exact, gate_us)
    assert quiet["events_gated"] <= 0.05 * quiet["events"], f"seed {SEED}"
    assert (noise["events"] - noise["events_gated"]) * cut <= noise["events"], f"seed {SEED}"
    kept = seen - both["events_gated"]
    noise_left = (noise["events"] - noise["events_gated"]) * 1.15
    assert kept >= 0.95 * quiet["events"], f"seed {SEED}"
    assert kept <= quiet["events"] + noise_left, f"seed {SEED}"


def test_gate_off_or_as_long_as_the_period_removes_nothing():
    signal = line(1000.0, periods=10)
    parts = [signal, background(5.0, int(signal[0][-1]))]
    modulation = Modulation(1000.0, on_edge_us=EDGE_US)
    for gate_us in (0, 1000 - LEAD_US, GATE_MAX_US):
        found, counts = run(stream(parts), modulation, gate_us)
        assert counts["events_gated"] == 0
        assert len(found) == len(run(stream(parts), modulation, 0)[0])


def test_a_sine_has_no_edges_to_gate_by():
    assert phase_gate(Modulation(70.0, waveform="sine"), 1000).step == 0


def test_several_periods_per_profile_are_gated_each():
    data = stream([line(300.0, periods=12)])
    _, counts = run(data, Modulation(300.0, on_edge_us=EDGE_US), 600, periods_per_profile=4)
    assert counts["events_gated"] <= 0.05 * counts["events"], f"seed {SEED}"


def test_few_gross_errors_are_left_in_strong_background():
    signal = line(70.0)
    data = stream([signal, background(40.0, int(signal[0][-1]))])
    modulation = Modulation(70.0, on_edge_us=EDGE_US)
    true_row = CALIBRATION.model().row(1320.0)
    spread = {}
    for gate_us in (0, 1000, GATE_LEARNED):
        found, _ = run(data, modulation, gate_us)
        spread[gate_us] = float(np.quantile(np.abs(found.row - true_row), 0.95))
    assert spread[1000] < 0.6 * spread[0], f"seed {SEED}: {spread}"
    assert spread[GATE_LEARNED] < 0.7 * spread[0], f"seed {SEED}: {spread}"


def test_background_that_is_alike_in_near_columns_is_gated():
    signal = line(70.0)
    t, x, y, p = background(20.0, int(signal[0][-1]))
    texture = [(t, (x + shift) % COLUMNS, y, p) for shift in range(5)]
    data = stream([signal, *texture])
    modulation = Modulation(70.0, on_edge_us=EDGE_US)
    true_row = CALIBRATION.model().row(1320.0)
    error_px = []
    for gate_us in (0, GATE_LEARNED):
        chosen = Settings(phase_gate_us=gate_us)
        found, reconstructor = reconstruct(data, modulation, chosen, calibration=CALIBRATION)
        error_px.append(np.quantile(np.abs(found.row - true_row), 0.68))
    print(f"seed {SEED}: {error_px[0]:.3f} px, with the gate {error_px[1]:.3f} px")
    assert error_px[1] < 0.7 * error_px[0]
    # Most events may be background that a learned gate is there to remove.
    assert 2 * reconstructor.counters["events_gated"] > reconstructor.counters["events"]
    assert not any("phase_gate_us removes" in line for line in reconstructor.warnings)


@dataclass(frozen=True)
class HalfDark(Plane):
    """The second half of the travel is dark, where pixels are slow."""

    def reflectance(self, stage_mm, columns, model):
        dark = np.asarray(stage_mm) > 20.0
        return np.where(dark[:, None], 0.05, 1.0) + np.zeros(np.size(columns))


def recorded(folder, scene, columns=320, speed_mm_s=50.0, travel_mm=(10.0, 30.0), pixels="paper"):
    narrow = replace(CALIBRATION, columns=columns, principal_column=None)
    return simulate_recording(
        folder, scene, narrow, Modulation(70.0), *travel_mm, speed_mm_s, SEED,
        parameters=preset(pixels),
    )  # fmt: skip


def both(recording) -> list:
    """Return what comes of a recording without a gate and with one that is learned."""
    return [
        reconstruct_recording(recording, Settings(phase_gate_us=gate_us))
        for gate_us in (0, GATE_LEARNED)
    ]


def test_a_gate_that_does_not_halve_the_variance_is_not_used(tmp_path):
    without, learned = both(recorded(tmp_path, Plane(1320.0, slope_column=0.2)))
    assert learned.counters["events_gated"] == 0
    assert np.array_equal(learned.profiles.row, without.profiles.row)


def test_a_learned_gate_reduces_the_error(tmp_path):
    plane = Plane(1320.0, slope_column=0.2)
    recording = recorded(tmp_path, plane, pixels="noisy")
    error_mm = []
    for found in both(recording):
        stage_mm = recording.stage.position_mm(found.profiles.t_us)
        truth_mm = true_range_mm(
            plane, recording.calibration.model(), stage_mm, found.profiles.column
        )
        error_mm.append(np.quantile(np.abs(found.profiles.range_mm - truth_mm), 0.68))
    assert error_mm[1] < 0.7 * error_mm[0], f"seed {SEED}"
    assert found.counters["events_gated"] > 0


def test_slow_pixels_of_a_surface_that_becomes_dark_keep_their_points(tmp_path):
    without, learned = both(recorded(tmp_path, HalfDark(1320.0), pixels="noisy"))
    assert learned.counters["events_gated"] > 0
    assert len(learned.profiles) > 0.999 * len(without.profiles), f"seed {SEED}"


def test_a_column_with_many_late_events_does_not_change_the_next_one(tmp_path):
    recording = recorded(tmp_path, Plane(1320.0, slope_column=0.2), pixels="noisy")
    modulation, column = recording.modulation, 100
    period_us, first_us = modulation.period_us, modulation.on_edge_us
    data = b"".join(RawReader(recording.events_path).chunks(1 << 20))
    events = Decoder(320, CALIBRATION.rows).decode(data)
    t, x, y, p = events.t, events.x, events.y, events.p
    row = round(float(np.mean(y[x == column]))) + 6
    rng = np.random.default_rng(SEED)
    times = []
    # A column has room for 128 events, and for more once it is full.
    for k in range(12, 24):
        edge_us = first_us + k * period_us
        times += [edge_us + rng.integers(300, 900, 4 * k), edge_us + rng.integers(5500, 6900, 110)]
    added_us = np.concatenate(times).astype(np.int64)
    ones = np.ones(added_us.size, np.uint8)
    more = added_us, column * ones.astype(np.uint16), row * ones.astype(np.uint16), ones
    rows = []
    for parts in ([(t, x, y, p)], [(t, x, y, p), more]):
        chosen = Settings(phase_gate_us=GATE_LEARNED, smoothing_half_width=0)
        found, reconstructor = reconstruct(
            stream(parts), modulation, chosen, calibration=recording.calibration
        )
        assert reconstructor.counters["events_gated"] > 0
        near = np.isin(found.column, (column - 1, column + 1))
        rows.append(found.row[near])
    moved_px = np.abs(rows[1] - rows[0]).max()
    print(f"rows beside it moved by {moved_px:.3f} px at most")
    assert moved_px < 0.02, f"seed {SEED}"


def test_a_learned_gate_does_not_move_a_line_that_moves_while_it_is_lit(tmp_path):
    plane = Plane(1100.0, slope_stage=1.2, pivot_mm=40.0)
    recording = recorded(tmp_path, plane, speed_mm_s=300.0, travel_mm=(10.0, 70.0))
    without, learned = both(recording)
    moved_px = learned.profiles.row - without.profiles.row
    print(f"rows moved by {moved_px.mean():.3f} px on average")
    assert abs(moved_px.mean()) < 0.03, f"seed {SEED}"


@pytest.mark.parametrize(
    ("scene", "columns", "pixels", "speed_mm_s", "travel_mm", "most_mm"),
    [
        # These columns have all of its first lines, which are an ear.
        (named("face"), 640, "paper", 100.0, (0.0, 200.0), 0.172),
        (Plane(1100.0, slope_stage=1.2, pivot_mm=40.0), 1280, "noisy", 300.0, (10.0, 70.0), 0.273),
    ],
    ids=["the first lines are few and weak", "the stage is at rest at first"],
)
def test_a_learned_gate_does_not_lag(
    tmp_path, scene, columns, pixels, speed_mm_s, travel_mm, most_mm
):
    calibration = replace(CALIBRATION, columns=columns, principal_column=None)
    recording = simulate_recording(
        tmp_path, scene, calibration, Modulation(70.0), *travel_mm, speed_mm_s, 0,
        parameters=preset(pixels),
    )  # fmt: skip
    profiles = reconstruct_recording(recording, Settings(phase_gate_us=GATE_LEARNED)).profiles
    stage_mm = recording.stage.position_mm(profiles.t_us)
    truth_mm = true_range_mm(scene, calibration.model(), stage_mm, profiles.column)
    assert np.nanmedian(np.abs(profiles.range_mm - truth_mm)) < most_mm, "seed 0"


def on_steps(folder, pixels):
    """A sweep over steps, and the range errors without a gate and with one to be learned."""
    scene = named("steps")
    calibration = load_calibration("config_3")
    recording = simulate_recording(
        folder, scene, calibration, Modulation(70.0), 10.0, 70.0, 50.0, 0,
        parameters=preset(pixels),
    )  # fmt: skip
    found = both(recording)
    errors_mm = []
    for profiles in (part.profiles for part in found):
        stage_mm = recording.stage.position_mm(profiles.t_us)
        truth_mm = true_range_mm(scene, calibration.model(), stage_mm, profiles.column)
        errors_mm.append(np.abs(profiles.range_mm - truth_mm))
    return found, errors_mm


def test_a_gate_is_chosen_again_where_the_line_rests_behind_a_leap(tmp_path):
    _, (without, learned) = on_steps(tmp_path, "narrow")
    assert np.median(learned) < 1.1 * np.median(without), "seed 0"


def test_a_line_that_leaps_to_another_surface_keeps_its_gate_and_flags(tmp_path):
    (_, found), (_, error_mm) = on_steps(tmp_path, "noisy")
    profiles = found.profiles
    wrong = error_mm > 2.2
    flagged = np.mean(profiles.flags[wrong] > 0)
    print(f"seed 0: {flagged:.2f} of {wrong.sum()} wrong points have a flag")
    assert found.counters["events_gated"] > 0.1 * found.counters["events"]
    assert flagged > 0.5, "seed 0"


@pytest.mark.parametrize("case", ["swapped polarity", "wrong frequency"])
def test_a_learned_gate_that_does_not_help_takes_next_to_nothing(case):
    t, x, y, p = line(70.0)
    data = stream([(t, x, y, 1 - p if case == "swapped polarity" else p)])
    modulation = Modulation(83.0 if case == "wrong frequency" else 70.0, on_edge_us=EDGE_US)
    found, counters = run(data, modulation, GATE_LEARNED)
    assert counters["events_gated"] < 0.01 * counters["events"]
    assert len(found) >= 0.99 * len(run(data, modulation, 0)[0])


@pytest.mark.parametrize("method", ["mean", "median"])
def test_methods_of_full_columns_learn_no_gate(method):
    signal = line(70.0)
    data = stream([signal, background(40.0, int(signal[0][-1]))])
    settings = Settings(centroid=method, phase_gate_us=GATE_LEARNED)
    modulation = Modulation(70.0, on_edge_us=EDGE_US)
    _, reconstructor = reconstruct(data, modulation, settings, calibration=CALIBRATION)
    assert reconstructor.counters["events_gated"] == 0
