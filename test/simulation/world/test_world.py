"""The simulated world: bytes against truth."""

import random
from dataclasses import asdict, replace
from fractions import Fraction

import numpy as np
import pytest

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.clocks import MotionPlan, plan_move
from eschorty_ros.core.evt3 import Decoder
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.core.reconstruction import reconstruct_recording
from eschorty_ros.core.storage import load_recording
from eschorty_ros.report.accuracy import stage_and_range_mm
from eschorty_ros.simulation.pixels import PixelParameters
from eschorty_ros.simulation.scenes import Plane, Sphere, Steps
from eschorty_ros.simulation.world import (
    STEP_MM,
    Gate,
    LaserTimeline,
    StageTimeline,
    World,
    simulate_recording,
)
from eschorty_ros.simulation.world import world as world_module

SEED = 11
FULL = load_calibration("config_3")
SMALL = replace(FULL, columns=96, principal_column=None)
WAVE = Modulation(70.0, 0.5, "square", 1000)


def decoded(data: bytes, columns: int) -> tuple[np.ndarray, ...]:
    """Return the events of a stream; fails on any anomaly the decoder counts."""
    decoder = Decoder(columns, 720)
    events = decoder.decode(data)
    counters = asdict(decoder.counters)
    assert counters.pop("events") == events.t.size
    assert not any(counters.values()), counters
    return events.t.copy(), events.x.copy(), events.y.copy(), events.p.copy()


def moving(scene, seed: int = SEED, **options) -> World:
    """A small world under a stage that moves, the laser going on, off and on again."""
    world = World(scene, SMALL, seed=seed, **options)
    world.set_laser(3_333, True, WAVE)
    world.set_laser(150_007, False)
    world.set_laser(170_000, True, Modulation(200.0, 0.3, "square", -77))
    world.set_stage(MotionPlan(0, 20.0))
    world.set_stage(plan_move(30_000_000, 20.0, 60.0, 250.0, 2000.0))
    return world


def in_pieces(world: World, until_us: int, longest_us: int) -> bytes:
    """Advance in random steps."""
    rng = random.Random(SEED)
    parts = []
    while world.now_us < until_us:
        parts.append(world.advance(min(world.now_us + rng.randint(0, longest_us), until_us)))
    return b"".join(parts)


@pytest.mark.parametrize(
    "scene", [Steps(stage_band_mm=7.0), Plane(1320.0, 0.8, 0.5), Sphere(1320.0, 40.0, 0.0, 30.0)]
)
def test_bytes_do_not_depend_on_how_time_is_cut(scene) -> None:
    print(f"seed {SEED}")
    uncut = moving(scene).advance(300_000)
    assert len(uncut) > 100_000
    assert moving(scene, seed=SEED + 1).advance(300_000) != uncut
    for longest_us in (300, 5_000, 70_000):
        assert in_pieces(moving(scene), 300_000, longest_us) == uncut


def test_streams_are_clean_ordered_and_full_of_vectors() -> None:
    world = moving(Steps())
    data = world.advance(300_000)
    t, x, y, p = decoded(data, 96)
    assert t.size == world.events
    assert np.all(np.diff(t) >= 0)
    assert t[-1] < 300_000
    assert set(p.tolist()) == {0, 1}
    assert len(np.unique(np.stack((t, x, y, p)), axis=1).T) == t.size


def test_line_lies_where_the_range_equation_puts_it() -> None:
    model = FULL.model()
    for range_mm in (820.0, 1320.0, 2050.0):
        world = World(Plane(range_mm), SMALL, seed=SEED, background_hz=0.0)
        world.set_laser(0, True, WAVE)
        t, x, y, _ = decoded(world.advance(100_000), 96)
        assert t.size > 96 * 6 * 36
        count = np.bincount(x, minlength=96)
        mean = np.bincount(x, weights=y, minlength=96) / count
        assert np.max(np.abs(mean - float(model.row(range_mm)))) < 0.8
        assert mean.mean() == pytest.approx(float(model.row(range_mm)), abs=0.3)


def test_default_scan_has_44_events_per_column_and_period_and_5_percent_background() -> None:
    lit, dark = (World(Steps(), FULL, seed=SEED) for _ in range(2))
    lit.set_laser(0, True, Modulation(70.0, 0.5, "square", 0))
    lit.set_stage(plan_move(0, 10.0, 110.0, 50.0, 2000.0))
    data = lit.advance(200_000)
    t, x, _, _ = decoded(data, 1280)
    dark.advance(200_000)
    assert dark.events / t.size == pytest.approx(0.05, abs=0.005)
    per_column = np.bincount(x, minlength=1280) / 14
    assert 34 < per_column.min() < np.median(per_column) < per_column.max() < 70
    # The table of P* has 2179 a second at 50 Hz.
    assert (t.size - dark.events) / 1280 / 14 == pytest.approx(2179 / 50, rel=0.06)
    assert len(data) / t.size < 2.6


def test_background_is_poisson_all_over_the_sensor() -> None:
    world = World(Plane(), FULL, seed=SEED, background_hz=1.0)
    t, x, y, p = decoded(world.advance(500_000), 1280)
    expected = 1280 * 720 * 0.5
    assert abs(t.size - expected) < 4 * np.sqrt(expected)
    cells = np.histogram2d(x, y, bins=(16, 9), range=((0, 1280), (0, 720)))[0].ravel()
    chi2 = np.sum((cells - t.size / cells.size) ** 2) / (t.size / cells.size)
    assert abs(chi2 - 143) < 4 * np.sqrt(2 * 143)
    counts = np.histogram(t, bins=200, range=(0, 500_000))[0]
    assert counts.var() / counts.mean() == pytest.approx(1.0, abs=0.4)
    assert p.mean() == pytest.approx(0.5, abs=0.005)


def test_without_laser_the_line_gives_nothing() -> None:
    quiet = PixelParameters(noise=0.0)
    world = World(Plane(slope_stage=1.0), SMALL, quiet, SEED, background_hz=0.0)
    world.set_stage(plan_move(0, 0.0, 100.0, 200.0, 2000.0))
    data = world.advance(400_000)
    assert world.events == 0
    assert decoded(data, 96)[0].size == 0
    # The sensor keeps telling the time.
    assert len(data) == 2 * (400_000 // 4096 + 1)
    world.set_laser(400_000, True, WAVE)
    world.advance(500_000)
    assert world.events > 0
    world.set_laser(500_000, False)
    world.advance(502_500)
    seen = world.events
    world.advance(800_000)
    assert world.events == seen


def test_truth_is_the_scene_at_the_middle_of_each_lit_phase() -> None:
    scene = Sphere(1320.0, 40.0, 0.0, 8.0, backdrop_mm=None)
    world = World(scene, SMALL, seed=SEED, background_hz=0.0)
    world.set_laser(0, True, Modulation(70.0, 0.4, "square", 1000))
    plan = plan_move(0, 30.0, 50.0, 100.0, 2000.0)
    world.set_stage(plan)
    _, x, _, _ = decoded(world.advance(230_000), 96)
    truth = world.truth
    period = 1e6 / 70.0
    times = np.unique(truth["t_us"])
    phase = (times - 1000 - 0.2 * period) / period
    assert np.max(np.abs(phase - np.round(phase))) * period < 2.0
    assert 5 < times.size < 17
    for t_us in times:
        here = truth[truth["t_us"] == t_us]
        stage = plan.state(int(t_us) * 1000)[0]
        expected = scene.range_mm(stage, np.arange(96), SMALL.model())[0]
        assert here["column"].tolist() == np.flatnonzero(np.isfinite(expected)).tolist()
        assert np.array_equal(here["range_mm"], expected[np.isfinite(expected)])
    # Rays that miss the sphere light nothing.
    assert set(x.tolist()) <= set(truth["column"].tolist())


def test_a_lit_phase_that_switching_off_cuts_is_no_period_of_the_truth() -> None:
    world = World(Plane(1300.0), SMALL, seed=SEED, background_hz=0.0)
    world.set_laser(0, True, Modulation(70.0, 0.5, "square", 1000))
    # 3 ms after the fifth rising edge.
    world.set_laser(1000 + 4 * 14_286 + 3000, False)
    world.advance(200_000)
    ends_us = np.unique(world.truth["t_us"]) + 3571
    assert ends_us[-1] < 1000 + 4 * 14_286
    assert ends_us.size >= 4


def test_a_line_beyond_the_sensor_is_neither_seen_nor_true() -> None:
    world = World(Plane(3000.0), SMALL, seed=SEED, background_hz=0.0)
    world.set_laser(0, True, WAVE)
    world.advance(100_000)
    assert world.events == 0
    assert world.truth.size == 0


def test_moving_surface_is_followed_within_a_lit_phase() -> None:
    equal = PixelParameters(threshold_mismatch=0.0, noise=0.0)
    # The slope along the line gives the columns different phases between rows.
    scene = Plane(1320.0, slope_stage=1.0, slope_column=0.5)
    world = World(scene, SMALL, equal, SEED, background_hz=0.0)
    wave = Modulation(70.0, 0.5, "square", 0)
    world.set_laser(0, True, wave)
    world.set_stage(MotionPlan(0, 0.0, 210.0, (10.0,), (0.0,)))
    t, x, y, p = decoded(world.advance(400_000), 96)
    model = SMALL.model()
    level = scene.range_mm([0.0], np.arange(96), model)[0]
    row_at = model.row(level[x] + 210e-6 * t)
    started, lead, found, expected = [], [], 0, 0.0
    redraw_us = int(STEP_MM / 210e-6)
    for k in range(1, 28):
        edge = wave.edge_us(k)
        fall_us = edge + 7143
        at_edge = (p == 1) & (t > edge) & (t < edge + 1000)
        started.extend(y[at_edge] - row_at[at_edge])
        under_way = (p == 1) & (t > edge + 1500) & (t < fall_us)
        lead.extend(y[under_way] - row_at[under_way])
        found += int(under_way.sum())
        # Redrawn every 1190 us from 595 us on, in the middle of the time to the next: the first is
        # before the count, the last has half of the time left.
        ends = model.row(level + 210e-6 * (edge + redraw_us * np.array([[1.0], [5.75]])))
        expected += float(np.diff(ends, axis=0).sum())
    slope_px_mm = float(model.row(1320.5) - model.row(1319.5))
    assert abs(np.mean(started)) < 0.1
    # While the line moves, each row it newly reaches fires once, at the line's leading flank.
    assert found == pytest.approx(expected, rel=0.1)
    thickness = 1.0 - slope_px_mm / float(model.rows_per_mm_off_sheet(1320.0))
    flank = 4.1 * thickness * np.sqrt(2.0 * np.log(5.5 / np.expm1(0.25)))
    assert np.mean(lead) == pytest.approx(flank, abs=0.15)


def test_a_moving_line_is_where_it_would_be_without_steps(monkeypatch) -> None:
    ahead, scene, model = [], Plane(1100.0, 1.5, 0.3), SMALL.model()
    level = scene.range_mm([0.0], np.arange(96), model)[0]
    for step_mm in (STEP_MM, 0.2 * STEP_MM):
        monkeypatch.setattr(world_module, "STEP_MM", step_mm)
        world = World(scene, SMALL, seed=SEED, background_hz=0.0)
        world.set_laser(0, True, Modulation(70.0, on_edge_us=0))
        world.set_stage(MotionPlan(0, 0.0, 300.0, (10.0,), (0.0,)))
        t, x, y, _ = decoded(world.advance(400_000), 96)
        ahead.append(np.mean(y - model.row(level[x] + 450e-6 * t)))
    # 0.32 rows per millisecond.
    assert abs(ahead[0] - ahead[1]) < 0.05, f"seed {SEED}: {ahead}"


def test_changes_of_the_past_and_unknown_waves_are_refused() -> None:
    world = World(Plane(), SMALL, seed=SEED)
    world.advance(10_000)
    with pytest.raises(ArgumentError, match="9999 us and 10000"):
        world.set_laser(9_999, False)
    with pytest.raises(ArgumentError, match="simulated"):
        world.set_stage(plan_move(9_999_000, 0.0, 1.0, 1.0, 1.0))
    with pytest.raises(ArgumentError, match="until_us"):
        world.advance(9_999)
    with pytest.raises(ArgumentError, match="on_edge_us"):
        world.set_laser(20_000, True, Modulation(70.0))
    with pytest.raises(ArgumentError, match="without a modulation"):
        world.set_laser(20_000, True)


@pytest.mark.parametrize("frequency_hz", [16.0, 69.99731, 128.0, 19_999.9])
def test_gate_edges_agree_with_the_modulation(frequency_hz: float) -> None:
    wave = Modulation(frequency_hz, 0.3, "square", -12_345)
    gate = Gate(wave)
    rng = np.random.default_rng(SEED)
    for t_us in rng.integers(-(10**9), 10**9, 200).tolist():
        k = gate.index(t_us)
        assert wave.edge_us(k) <= t_us < wave.edge_us(k + 1)
        assert (gate.level(t_us) == 1.0) == (t_us < gate.fall_us(k))
        assert abs(gate.fall_us(k) - wave.edge_us(k) - 0.3 * wave.period_us) <= 1.0
        nearest = gate.next_us(t_us)
        assert gate.level(nearest) != gate.level(t_us)
        assert gate.level(nearest - 1) == gate.level(t_us)


@pytest.mark.parametrize(("frequency_hz", "duty"), [(70.0, 0.5), (300.0, 0.3), (19_999.9, 0.5)])
def test_a_sine_rises_and_falls_in_steps(frequency_hz: float, duty: float) -> None:
    wave = Modulation(frequency_hz, duty, "sine", 500)
    gate = Gate(wave)
    t_us, light, steps = gate.rise_us(3), [], []
    while t_us < gate.rise_us(4):
        end_us = gate.next_us(t_us)
        light.append(gate.level(t_us))
        steps.append(end_us - t_us)
        assert gate.level(end_us - 1) == light[-1]
        t_us = end_us
    assert t_us == gate.rise_us(4)
    assert sum(steps) == gate.rise_us(4) - gate.rise_us(3)
    top = int(np.argmax(light))
    assert np.all(np.diff(light[: top + 1]) > 0)
    assert np.all(np.diff(light[top + 1 :]) < 0)
    assert max(light) > 0.98
    assert min(light) < 0.02
    assert sum(steps[: len(steps) // 2]) == pytest.approx(duty * wave.period_us, abs=2.0)
    assert np.average(light, weights=steps) == pytest.approx(0.5, abs=0.03)


@pytest.mark.parametrize(("waveform", "duty"), [("sine", 0.5), ("pulse", 0.1)])
def test_other_waveforms_are_reconstructed_too(waveform: str, duty: float, tmp_path) -> None:
    print(f"seed {SEED}")
    recording = simulate_recording(
        tmp_path / "rec", Plane(1320.0, 0.3), SMALL, Modulation(70.0, duty, waveform),
        10.0, 30.0, 50.0, SEED,
    )  # fmt: skip
    assert recording.modulation == Modulation(70.0, duty, waveform, 50_000)
    result = reconstruct_recording(recording)
    truth = recording.truth
    periods = np.unique(truth["t_us"])
    assert np.median(np.diff(periods)) == pytest.approx(1e6 / 70, abs=1.0)
    assert len(result.points) == pytest.approx(96 * periods.size, rel=0.05)
    stage_mm, range_mm = stage_and_range_mm(result.points)
    error = range_mm - (1320.0 + 0.3 * stage_mm)
    assert np.median(np.abs(error)) < 0.7
    assert abs(np.median(error)) < 0.3


def test_timelines_replace_the_future_and_drop_the_past() -> None:
    laser, stage = LaserTimeline(), StageTimeline()
    laser.set(100, True, Modulation(100.0, 0.5, "square", 0))
    laser.set(900, False, None)
    laser.set(500, False, None)
    assert [t for t in (99, 100, 499, 500, 950) if laser.level(t) > 0.0] == [100, 499]
    assert [laser.next_us(t) for t in (99, 100, 500)] == [100, 500, None]
    stage.set(0, MotionPlan(0, 3.0), 0)
    stage.set(1000, MotionPlan(1_000_000, 5.0), 0)
    assert [stage.state(t)[0] for t in (-1, 0, 999, 1000)] == [0.0, 3.0, 3.0, 5.0]
    laser.drop_before(600)
    stage.drop_before(2000)
    assert not laser.level(600)
    assert stage.state(2000)[0] == 5.0


def test_recording_holds_everything(tmp_path) -> None:
    shares: list[float] = []
    options = {"start_mm": 30, "stop_mm": 20.0, "speed_mm_s": 100.0, "seed": 5}
    scene = Steps(stage_band_mm=3.0)
    made = simulate_recording(
        tmp_path / "a", scene, SMALL, progress=lambda share, _: shares.append(share), **options
    )
    names = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert names == ["calibration.yaml", "events.raw", "laser.yaml", "stage.csv", "truth.csv"]
    assert shares[-1] == 1.0
    recording = load_recording(tmp_path / "a")
    assert recording.modulation == made.modulation == Modulation(70.0, 0.5, "square", 50_000)
    assert recording.calibration == SMALL
    t, _, _, _ = decoded((tmp_path / "a" / "events.raw").read_bytes().split(b"% end\n")[1], 96)
    assert recording.stage.first_us <= t[0]
    assert t[-1] <= recording.stage.last_us
    truth = recording.truth
    assert truth["t_us"].min() > 50_000
    stage_mm = recording.stage.position_mm(truth["t_us"])
    assert (stage_mm.min(), stage_mm.max()) == pytest.approx((20.0, 30.0), abs=1e-6)
    expected = scene.range_mm(stage_mm, np.arange(96), SMALL.model())
    same = np.abs(expected[np.arange(truth.size), truth["column"]] - truth["range_mm"]) < 1e-6
    # stage.csv is linear between its samples: at a step the two may fall on different sides.
    assert same.mean() > 0.9


def test_recording_into_an_impossible_folder_is_refused(tmp_path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ArgumentError, match=r"cannot write .*; choose a folder"):
        simulate_recording(tmp_path / "file" / "rec", Plane(), SMALL)


def test_triggers_come_at_the_edges_of_the_gate_however_time_is_cut() -> None:
    def with_triggers() -> World:
        world = moving(Plane(1320.0))
        world.trigger_input = world.laser_edges
        return world

    uncut = with_triggers().advance(300_000)
    assert in_pieces(with_triggers(), 300_000, 3_554) == uncut
    triggers = Decoder(96, 720).decode(uncut).triggers
    gates = [
        (3_333, 150_007, Gate(WAVE)),
        (170_000, 300_000, Gate(Modulation(200.0, 0.3, "square", -77))),
    ]
    expected = []
    for begin_us, end_us, gate in gates:
        high = np.array([gate.high(t) for t in range(begin_us, end_us)])
        changes = np.flatnonzero(np.diff(high.astype(int))) + 1
        expected += [(begin_us, 1)] * int(high[0])
        expected += [(begin_us + int(k), int(high[k])) for k in changes]
        if high[-1] and end_us < 300_000:
            expected.append((end_us, 0))
    assert list(zip(triggers.t.tolist(), triggers.edge.tolist(), strict=True)) == expected


def test_a_fast_sensor_clock_stretches_wave_and_motion() -> None:
    rate = 1 + Fraction(50, 1_000_000)
    world = World(Plane(1320.0), SMALL, seed=SEED)
    plan = plan_move(1_000_000_000, 10.0, 60.0, 50.0, 2000.0)
    world.set_stage(plan, 1_000_000_000, 0, rate)
    world.set_laser(0, True, Modulation(100.0, 0.5, "square", 0), rate)
    edges = world.laser_edges(0, 1_000_200)
    assert edges[-1] == (1_000_050, True)
    at_us = 500_025
    assert world.stage_mm(at_us) == pytest.approx(float(plan.state(1_500_000_000)[0]), abs=1e-6)
