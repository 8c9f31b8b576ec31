"""What a recording says about itself: a line for every contradiction, and none for a good one."""

from dataclasses import replace

import numpy as np
import pytest

from eschorty_ros.core.base.errors import ArgumentError, CalibrationError, FormatError
from eschorty_ros.core.clocks import StageTrack
from eschorty_ros.core.evt3 import Decoder, Encoder
from eschorty_ros.core.evt3 import words as w3
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.core.reconstruction import Reconstructor, Settings, reconstruct_recording
from eschorty_ros.core.reconstruction.settings import KEEP
from eschorty_ros.core.reconstruction.stage_faults import stage_faults
from eschorty_ros.core.storage import ScanLog, load_recording
from eschorty_ros.core.storage.raw_file import RawReader, RawWriter
from eschorty_ros.simulation.pixels import preset
from eschorty_ros.simulation.scenes import Plane, named
from eschorty_ros.simulation.world import simulate_recording

NARROW = replace(load_calibration("config_3"), columns=96, principal_column=None)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return simulate_recording(
        tmp_path_factory.mktemp("warned") / "rec", Plane(1300.0), NARROW, stop_mm=40.0, seed=2
    )


def at_hz(recording, frequency_hz):
    return replace(recording, modulation=replace(recording.modulation, frequency_hz=frequency_hz))


def with_duty(recording, duty):
    return replace(recording, modulation=replace(recording.modulation, duty=duty))


def with_edge(recording, later_us):
    edge_us = recording.modulation.on_edge_us + later_us
    return replace(recording, modulation=replace(recording.modulation, on_edge_us=edge_us))


def with_stage(recording, later_us, part=slice(None), scale=1.0):
    samples = recording.stage_samples[part].copy()
    samples["position_mm"] *= scale
    samples["t_us"] += later_us
    track = StageTrack()
    track.append(samples["t_us"], samples["position_mm"])
    return replace(recording, stage=track, stage_samples=samples)


def with_waves(recording):
    """The stage wobbles by 2 mm, as its log shows six times in each turn."""
    samples = recording.stage_samples[::5].copy()
    samples["position_mm"] += 2.0 * np.sin(np.arange(samples.size))
    return with_stage(replace(recording, stage_samples=samples), 0)


def with_half_of_the_events(recording, half=0):
    data = recording.events_path.read_bytes()
    begin = data.index(b"% end\n") + 6
    middle = begin + (len(data) - begin) // 4 * 2
    cut = recording.path.parent / f"cut{half}.raw"
    cut.write_bytes(data[:begin] + data[middle:] if half else data[:middle])
    return replace(recording, events_path=cut)


def with_stage_at(recording, position_mm, part=slice(None)):
    recording = with_stage(recording, 0)
    recording.stage_samples["position_mm"][part] = position_mm
    return with_stage(recording, 0)


def with_broken_words(recording):
    data = recording.events_path.read_bytes()
    begin = data.index(b"% end\n") + 6
    broken = recording.path.parent / "broken.raw"
    broken.write_bytes(data[:begin] + b"x" + data[begin:])
    return replace(recording, events_path=broken)


def with_scan_elsewhere(recording):
    scan = ScanLog(scan_id="s", state="ended", start_mm=500.0, stop_mm=600.0)
    return replace(recording, scan=scan)


def with_a_gap_of_the_stage(recording):
    limits = {"start_mm": 0.0, "stop_mm": 100.0, "stage_gap_s": 0.05}
    scan = ScanLog(scan_id="s", state="ended", **limits)
    samples = np.delete(recording.stage_samples, np.arange(30, 41))
    return replace(recording, stage_samples=samples, scan=scan).earlier(0)


def test_a_light_of_the_other_polarity_has_its_reason_alone(tmp_path):
    """ON events come where OFF ones are expected, four fifths of a period later."""
    short = Modulation(70.0, 0.2)
    recording = simulate_recording(tmp_path, Plane(1300.0), NARROW, short, stop_mm=30.0, seed=2)
    data = recording.events_path.read_bytes()
    begin = data.index(b"% end\n") + 6
    words = np.frombuffer(data[begin:], "<u2").copy()
    words[np.isin(words >> 12, (w3.ADDR_X, w3.VECT_BASE_X))] ^= w3.ADDRESSES
    recording.events_path.write_bytes(data[:begin] + words.tobytes())
    (line,) = reconstruct_recording(load_recording(tmp_path)).warnings
    assert "check its frequency, duty cycle and polarity" in line


def test_lines_that_the_limits_of_the_range_cut_are_no_fault_of_the_camera(tmp_path):
    """The region of interest ends a line's width behind the limit."""
    build = replace(NARROW, columns=480)
    recording = simulate_recording(tmp_path, named("steps"), build, stop_mm=30.0)
    result = reconstruct_recording(recording, Settings(range_max=1.3))
    assert (result.warnings, len(result.points) > 0) == ((), True)


def test_limits_of_the_range_without_a_point_are_the_reason(tmp_path):
    build = replace(NARROW, columns=480)
    recording = simulate_recording(
        tmp_path, named("steps"), build, stop_mm=30.0, parameters=preset("noisy")
    )
    result = reconstruct_recording(recording, Settings(range_min=1.3, range_max=1.301))
    (line,) = result.warnings
    assert "points are outside range_min and range_max; widen them" in line, "seed 0"
    assert len(result.points) == 0, "seed 0"


def test_the_share_of_cut_points_is_the_same_where_only_good_ones_are_kept(tmp_path):
    build = replace(NARROW, columns=480)
    near = Plane(build.model().range_limits_mm[0] + 8.0, slope_column=0.9)
    recording = simulate_recording(tmp_path, near, build, stop_mm=16.0, seed=1)
    found = {keep: reconstruct_recording(recording, Settings(keep=keep)) for keep in KEEP}
    counters = found["all"].counters
    assert 0.33 < counters["points_cut"] / counters["points"] < 0.5, "seed 1"
    assert found["all"].warnings == found["good"].warnings == ()


@pytest.mark.parametrize("start_mm", [51.2, 51.8])
def test_a_step_that_passes_at_first_is_no_fault_of_the_camera(tmp_path, start_mm):
    build = replace(NARROW, columns=480)
    sweep = {"start_mm": start_mm, "stop_mm": 75.0, "seed": 0}
    result = reconstruct_recording(simulate_recording(tmp_path, named("steps"), build, **sweep))
    assert result.warnings == (), "seed 0"
    between_steps = (result.profiles.period > 20) & (result.profiles.period < 30)
    # As where no step passes at first.
    assert np.median(result.profiles.sigma_row[between_steps]) < 0.25, "seed 0"


def test_a_short_sweep_far_from_zero_is_not_in_metres(tmp_path):
    recording = simulate_recording(
        tmp_path, Plane(1300.0), NARROW, start_mm=10.0, stop_mm=10.1, speed_mm_s=1.0
    )
    assert reconstruct_recording(recording).warnings == ()


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


def test_one_pixel_in_the_dark_for_long_has_the_reason_of_a_dark_recording(tmp_path, recording):
    n = 600
    t_us = np.sort(np.random.default_rng(2).integers(0, 60_000_000, n))
    with RawWriter(tmp_path / "one.raw", NARROW.columns, NARROW.rows) as raw:
        raw.write(Encoder().encode(t_us, np.full(n, 90), np.full(n, 300), np.arange(n) % 2))
    dark = replace(at_hz(recording, 1000.0), events_path=tmp_path / "one.raw")
    found = reconstruct_recording(dark)
    assert len(found.points) == 0
    assert "events follow the laser's modulation at 1000 Hz" in found.warnings[-1]


def test_stage_positions_of_a_later_wrap_of_the_cameras_clock_are_those_of_the_events(recording):
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
        (lambda r: with_duty(r, 0.2), {}, "duty cycle is given as 0.2 and the events show 0.5", 1),
        (lambda r: with_duty(r, 0.95), {}, "cycle is given as 0.95 and the events show 0.5", 0),
        (lambda r: with_duty(r, 0.8), {}, "duty cycle is given as 0.8 and the events show 0.5", 1),
        (lambda r: with_edge(r, 2000), {}, "us after the edge that the events show", 1),
        (lambda r: with_edge(r, -5000), {}, "us before the edge that the events show", 1),
        (lambda r: with_stage(r, 100_000_000), {}, "covers 100.000 to 100.840 s of 0.000 to", 0),
        (lambda r: with_stage(r, 0, slice(10, 41)), {}, "covers 0.100 to 0.400 s of 0.000 to", 1),
        (lambda r: with_stage(r, 999 * r.stage_samples["t_us"]), {}, "times of both in micro", 1),
        (lambda r: with_half_of_the_events(r), {}, "mm after that; where these were scanned", 1),
        (lambda r: with_stage(r, 0, scale=1e-3), {}, "moves by 0.03 mm in stage.csv; where", 1),
        (lambda r: with_half_of_the_events(r, 1), {}, "mm before; where these were scanned", 1),
        (lambda r: with_waves(r), {}, "positions between them may be off by", 1),
        (lambda r: with_stage_at(r, 20.0), {}, "the stage stays at 20 mm in stage.csv", 1),
        (lambda r: with_stage_at(r, 180.0, 40), {}, "to 180 mm at 0.400 s in stage.csv; remove", 1),
        (lambda r: with_stage_at(r, 29.0, 40), {}, "to 29 mm at 0.400 s in stage.csv; remove", 1),
        (lambda r: r.corrected(replace(NARROW, name="other")), {}, "of config_3 and reconstr", 1),
        # In another wrap of the camera's clock, and in the host's time.
        (lambda r: with_stage(r, (4 << 24) + 6_000_000), {}, "have no stage position; give the", 0),
        (lambda r: with_stage(r, 10**8 << 24), {}, "have no stage position; give the stage log", 0),
        (with_a_gap_of_the_stage, {}, "to 0.825 s with gaps of up to 0.12 s: 768 of", 1),
        (with_scan_elsewhere, {}, "points are outside start to stop of the recorded scan", 0),
        (with_broken_words, {}, "are not as EVT3 has them", 0),
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


def test_points_that_keep_leaves_out_are_the_cause_of_an_empty_cloud(tmp_path):
    near_mm, _ = NARROW.model().range_limits_mm
    recording = simulate_recording(tmp_path / "rec", Plane(near_mm + 0.5), NARROW, stop_mm=4.0)
    result = reconstruct_recording(recording, Settings(keep="good"))
    assert result.warnings[-1].endswith("points have a flag; set keep to all")


@pytest.mark.parametrize(
    ("others", "idle"),
    [
        ({"centroid": "median"}, {"detail": "off"}),
        ({"smoothing_half_width": 0}, {"smoothing_gate_px": 0.1}),
        ({"isolation_events": 0}, {"isolation_gate_px": 0.1}),
        ({"reflectance": "off"}, {"footprint_sigma_px": 9.0}),
        ({"reflectance": "off"}, {"white_width_px": 9.0}),
    ],
)
def test_a_setting_without_effect_beside_the_others_is_named(recording, others, idle):
    settings = Settings(**others, **idle)
    with_it, without = (
        reconstruct_recording(recording, chosen).points for chosen in (settings, Settings(**others))
    )
    np.testing.assert_array_equal(with_it, without)
    settings.check_effect(others)
    (name,), (other,) = idle, others
    with pytest.raises(ArgumentError, match=f"{name} has no effect while {other} is"):
        settings.check_effect(idle)


def test_events_that_waited_for_the_phase_are_of_the_light_that_showed_it(recording):
    """A share of more than all of them was reported."""
    words = b"".join(RawReader(recording.events_path))
    size = len(words) // 64 * 2
    reconstructor = Reconstructor(NARROW, Modulation(70.0), Settings(column_first=1500))
    at = held = 0
    while held <= (count := reconstructor.counters["events_held"]):
        before, held = reconstructor.counters, count
        reconstructor.push(words[at : at + size])
        at += size
    reconstructor.flush()
    (line,) = reconstructor.warnings_since(before)
    share, _, cause = line.partition("%")
    assert cause.startswith(" of the events are outside the limits")
    assert int(share) <= 100


@pytest.mark.parametrize("hz", [35, 210])
def test_a_wrong_frequency_comes_before_the_warnings_that_follow_from_it(recording, hz):
    first, *_ = reconstruct_recording(at_hz(recording, hz)).warnings
    assert f"given as {hz} Hz and the events show 70" in first


FORTH_MM = np.linspace(10.0, 40.0, 60)
SWEEP_MM = np.concatenate([np.full(600, 10.0), FORTH_MM, FORTH_MM[::-1]])
NOISE_MM = np.random.default_rng(1).normal(0.0, 1.0, SWEEP_MM.size)


@pytest.mark.parametrize(
    "position_mm",
    [
        SWEEP_MM,
        SWEEP_MM + 0.1 * NOISE_MM,
        np.round(SWEEP_MM + 0.05 * NOISE_MM),
        10.0 + 0.001 * NOISE_MM,
        10.0 + 0.01 * NOISE_MM,
        np.full(SWEEP_MM.size, 10.0),
    ],
    ids=["sweep", "noise", "steps of 1 mm", "rest", "rest with noise", "same"],
)
def test_a_stage_that_rests_turns_or_is_coarse_does_not_jump(recording, position_mm):
    samples = np.empty(position_mm.size, recording.stage_samples.dtype)
    samples["t_us"], samples["position_mm"] = np.arange(position_mm.size) * 10_000, position_mm
    faults = stage_faults(replace(recording, stage_samples=samples), (0, samples["t_us"][-1]))
    assert not [line for line in faults if "jumps" in line]


@pytest.mark.parametrize(("first", "missing"), [(120, False), (150, False), (180, True)])
def test_what_the_stage_did_before_a_scan_is_no_missing_beginning(recording, first, missing):
    earlier_mm, own_mm = FORTH_MM, np.linspace(5.0, 40.0, 60)
    position_mm = np.concatenate([earlier_mm, own_mm[::-1], np.full(30, 5.0), own_mm])
    samples = np.empty(position_mm.size, recording.stage_samples.dtype)
    samples["t_us"], samples["position_mm"] = np.arange(position_mm.size) * 10_000, position_mm
    scan = ScanLog(scan_id="s", state="ended", start_mm=10.0, stop_mm=40.0)
    scanned = replace(recording, stage_samples=samples, scan=scan)
    faults = stage_faults(scanned, (int(samples["t_us"][first]), int(samples["t_us"][-1])))
    assert any("the stage has moved" in line for line in faults) == missing


def test_more_light_outside_the_scan_than_in_it_is_no_lack_of_events(recording):
    scan = ScanLog(scan_id="s", state="ended", start_mm=10.0, stop_mm=12.0)
    t_us, column = np.meshgrid(1_000_000 + 14_286 * np.arange(200), np.arange(96), indexing="ij")
    dark = Encoder().encode(t_us.ravel(), column.ravel(), *np.zeros((2, t_us.size), int))
    path = recording.path.parent / "dark.raw"
    path.write_bytes(recording.events_path.read_bytes() + dark)
    result = reconstruct_recording(replace(recording, events_path=path, scan=scan))
    assert len(result.points) > 0
    assert not any("fewer events" in line for line in result.warnings), result.warnings


def test_words_that_are_none_have_one_reason(recording):
    """Counts of a stream that cannot be read are not explained one by one."""
    lines = reconstruct_recording(with_broken_words(recording)).warnings
    assert not [line for line in lines if "follow the laser" in line or "periods_per" in line]


def test_what_no_setting_can_mend_is_an_error(recording):
    with pytest.raises(CalibrationError, match="of 96 x 720 and config_3 of one of 96 x 480; give"):
        reconstruct_recording(replace(recording, calibration=replace(NARROW, rows=480)))
    samples = recording.stage_samples[:80].copy()
    samples["t_us"] //= 1000
    track = StageTrack()
    track.append(samples["t_us"], samples["position_mm"])
    with pytest.raises(FormatError, match="moves at 50 m/s; write t_us in microseconds"):
        reconstruct_recording(replace(recording, stage=track, stage_samples=samples))


def test_edges_of_the_stage_that_a_recording_does_not_use_are_counted(recording, tmp_path):
    """In a scan recorded with them they have set the clock."""
    reader, decoder = RawReader(recording.events_path), Decoder(96, 720)
    events = decoder.decode(b"".join(reader.chunks(1 << 20)))
    edges_us = np.linspace(events.t[0], events.t[-1], 30).astype(np.int64)
    path = tmp_path / "edges.raw"
    with RawWriter(path, 96, 720) as writer:
        writer.write(Encoder().encode(
            events.t, events.x, events.y, events.p,
            trigger_t=edges_us, trigger_edge=np.ones(30, np.uint8),
        ))  # fmt: skip
    wired = replace(recording, events_path=path)
    warnings = reconstruct_recording(wired, Settings(trigger_source="stage")).warnings
    assert any(line.startswith("30 edges at the trigger input are not used") for line in warnings)
    for other, settings in (
        (replace(wired, settings={"trigger_source": "stage"}), Settings(trigger_source="stage")),
        (wired, Settings(trigger_source="none")),
        (recording, Settings(trigger_source="stage")),
    ):
        assert not any("edges" in line for line in reconstruct_recording(other, settings).warnings)
