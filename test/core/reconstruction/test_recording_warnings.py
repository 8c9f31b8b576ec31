"""What a recording says about itself: a line for every contradiction, and none for a good one."""

from dataclasses import replace

import pytest

from eschorty_ros.core.clocks import StageTrack
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.core.reconstruction import Settings, reconstruct_recording
from eschorty_ros.simulation.scenes import Plane, named
from eschorty_ros.simulation.world import simulate_recording

NARROW = replace(load_calibration("config_3"), columns=96, principal_column=47.5)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return simulate_recording(
        tmp_path_factory.mktemp("warned") / "rec", Plane(1300.0), NARROW, stop_mm=40.0, seed=2
    )


def at_hz(recording, frequency_hz):
    return replace(recording, modulation=replace(recording.modulation, frequency_hz=frequency_hz))


def with_stage(recording, later_us, part=slice(None), scale=1.0):
    samples = recording.stage_samples[part].copy()
    samples["position_mm"] *= scale
    samples["t_us"] += later_us
    track = StageTrack()
    track.append(samples["t_us"], samples["position_mm"])
    return replace(recording, stage=track, stage_samples=samples)


def with_half_of_the_events(recording):
    data = recording.events_path.read_bytes()
    cut = recording.path.parent / "cut.raw"
    cut.write_bytes(data[: len(data) // 4 * 2])
    return replace(recording, events_path=cut)


@pytest.mark.parametrize("scene", ["plane", "posts"])
def test_a_good_recording_has_no_warning(recording, tmp_path, scene):
    if scene == "posts":
        recording = simulate_recording(
            tmp_path, named(scene), load_calibration("config_3"), stop_mm=14.0, seed=2
        )
    found = reconstruct_recording(recording)
    assert (found.warnings, len(found.points) > 0) == ((), True)


def test_a_dark_recording_says_so(tmp_path):
    """A target beyond the calibration's last range leaves background alone."""
    dark = simulate_recording(tmp_path, Plane(2900.0), NARROW, stop_mm=40.0, seed=2)
    found = reconstruct_recording(dark)
    assert len(found.points) == 0
    assert "events follow the laser's modulation at 70 Hz" in found.warnings[-1]


def test_stage_positions_of_a_later_turn_of_the_cameras_clock_are_those_of_the_events(recording):
    later_us, edge_us = 3 << 24, recording.modulation.on_edge_us
    later = with_stage(recording, later_us)
    modulation = replace(recording.modulation, on_edge_us=edge_us + later_us)
    found = reconstruct_recording(replace(later, modulation=modulation))
    as_recorded = reconstruct_recording(recording)
    assert found.points.tobytes() == as_recorded.points.tobytes()
    (warning,) = found.warnings
    assert "3 x 16.777216 s" in warning


@pytest.mark.parametrize(
    ("change", "settings", "words", "points"),
    [
        *(
            (lambda r, hz=hz: at_hz(r, hz), {}, f"given as {hz} Hz and the events show 70", 1)
            for hz in (35, 71, 100, 140, 700)
        ),
        (lambda r: with_stage(r, 100_000_000), {}, "covers 100.000 to 100.840 s of 0.000 to", 0),
        (lambda r: with_stage(r, 0, slice(10, 41)), {}, "covers 0.100 to 0.400 s of 0.000 to", 1),
        (lambda r: with_half_of_the_events(r), {}, "mm after that; where these were scanned", 1),
        (lambda r: with_stage(r, 0, scale=1e-3), {}, "moves by 0.03 mm in stage.csv; where", 1),
        (lambda r: replace(r, calibration=replace(NARROW, rows=480)), {}, "of 96 x 480; give", 1),
        (lambda r: r, {"events_min": 1000}, "0 points: ", 0),
        (lambda r: r, {"events_min": 50}, "fewer events than events_min = 50; lower it", 1),
        (lambda r: r, {"range_min": 3.0}, "of the events are outside the limits of columns and", 0),
        (lambda r: r, {"column_first": 1500}, "100% of the events are outside the limits of", 0),
        (lambda r: r, {"phase_gate_us": 1}, "phase_gate_us removes 100% of the events; set", 0),
    ],
)  # fmt: skip
def test_a_contradiction_has_its_line(recording, change, settings, words, points):
    result = reconstruct_recording(change(recording), Settings(**settings))
    assert (len(result.points) > 0) == points
    assert sum(words in line for line in result.warnings) == 1, result.warnings
