"""Bytes to profiles: rows against the truth, splits, phase, scenes and counters."""

import os
import threading
from collections import Counter
from dataclasses import fields, replace

import numpy as np
import pytest
from independent_pixels import FIRST_EDGE_US, Camera, stream, wavy
from line_events import encoded, line_events
from reconstructing import CALIBRATION, KNOWN, assert_same, reconstruct

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.evt3 import Encoder, sort_readout
from eschorty_ros.core.line import SIGMA_FLOOR_PX
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.reconstruction import (
    Profiles,
    Reconstructor,
    Settings,
    add_stage,
    place,
    place_link,
    profile_length,
    profile_rows,
    reconstruct_recording,
    reconstructor,
    region_window,
    windows,
)
from eschorty_ros.simulation.scenes import Plane
from eschorty_ros.simulation.world import simulate_recording

SEED = 77
MODEL = CALIBRATION.model()
RAW = Settings(smoothing_half_width=0)


def flat(k, c):
    return np.full(c.shape, 350.0)


def lines(rows=flat, **options):
    return line_events(np.random.default_rng(SEED), rows, **options)


@pytest.mark.parametrize(
    ("fwhm", "events", "background"), [(20.0, 40.0, 0.0), (20.0, 40.0, 0.05), (20.0, 60.0, 0.3),
                                      (5.0, 40.0, 0.05), (2.5, 40.0, 0.3)]
)  # fmt: skip
def test_rows_reach_the_bound_and_every_lit_column_has_a_point(fwhm, events, background):
    data = encoded(lines(events=events, fwhm_px=fwhm, background=background, periods=12))
    found, _ = reconstruct(data, settings=Settings(smoothing_half_width=0, line_width_px=20.0))
    found = found.select(found.period >= 4)
    sigma2 = (fwhm / 2.3548) ** 2 + 1 / 12
    error = found.row - 350.0
    bound = np.sqrt(sigma2 * np.mean(1.0 / found.events))
    assert np.quantile(np.abs(error), 0.6827) < 1.15 * bound, f"seed {SEED}"
    assert abs(error.mean()) < 4 * bound / np.sqrt(len(error))
    assert len(found) >= 0.98 * 8 * 1280
    assert np.abs(found.range_mm - MODEL.range_mm(found.row)).max() == 0.0


def test_background_alone_gives_practically_no_points():
    one_column = lines(lambda k, c: np.where(c == 0, 350.0, np.nan), periods=60, events=22.0)
    found, _ = reconstruct(encoded(one_column))
    false = np.count_nonzero(found.column != 0)
    assert false <= 1e-4 * 60 * 1280, f"seed {SEED}: {false}"


@pytest.mark.parametrize("turned", [False, True])
def test_a_camera_turned_by_a_quarter_has_a_warning(turned):
    t_us, column, row, polarity = lines(columns=720, periods=8)
    pixels = (row, column) if turned else (column, row)
    _, found = reconstruct(encoded(sort_readout(t_us, *pixels, polarity)), Modulation(70.0))
    assert any("turn the camera" in line for line in found.warnings) == turned, f"seed {SEED}"


def _split_cases():
    rng = np.random.default_rng(SEED)
    events = line_events(rng, flat, frequency_hz=500.0, periods=40, columns=300, edge_us=5000)
    cut = line_events(
        rng,
        lambda k, c: np.where(4 <= k < 40, 716.0, 300.0 + 0.0 * c),
        frequency_hz=500.0,
        periods=44,
        columns=300,
        edge_us=5000,
    )
    # Events that are late scatter more over the rows.
    slow = {"frequency_hz": 100.0, "periods": 40, "columns": 300}
    prompt = line_events(rng, flat, **slow, edge_us=5000, fwhm_px=8.0)
    late = line_events(rng, flat, **slow, edge_us=8000, events=8.0, fwhm_px=60.0)
    late = sort_readout(*map(np.concatenate, zip(prompt, late, strict=True)))
    edges = 5000 + np.arange(40) * 2000 + rng.integers(-20, 21, 40)
    disturbed = np.sort(np.append(np.delete(edges, range(10, 16)), rng.integers(5000, 85_000, 8)))
    data, known = encoded(events), Modulation(500.0, on_edge_us=1000)
    # Off for 9 s, and with another phase after it.
    later = np.concatenate([events[0], events[0] + 9_000_700]), *(np.tile(v, 2) for v in events[1:])
    fast = line_events(rng, flat, frequency_hz=500.2, periods=100, columns=100, edge_us=5000)
    stray = np.sort(rng.integers(5000, 200_000, 30))
    return {
        "edge": (data, known, Settings()),
        "estimate": (data, Modulation(500.0), Settings()),
        "dark": (encoded(later), Modulation(500.0), Settings()),
        "drift": (encoded(fast), Modulation(500.0), Settings()),
        "stage": (encoded(fast, stray), Modulation(500.0), Settings(trigger_source="stage")),
        "late trigger": (encoded(events, edges[30:]), Modulation(500.0), Settings()),
        "stray trigger": (encoded(events, disturbed), Modulation(500.0), Settings()),
        "trigger": (encoded(events, np.delete(edges, [4, 5])), Modulation(500.0), Settings()),
        "filter": (data, known, Settings(noise_filter="activity")),
        "gate": (data, known, Settings(phase_gate_us=500)),
        "learned gate": (
            encoded(late),
            Modulation(100.0, on_edge_us=5000),
            Settings(phase_gate_us=-1),
        ),
        "learned": (data, known, Settings(centroid="learned")),
        "cut": (encoded(cut), known, Settings()),
    }


SPLIT_CASES = _split_cases()


@pytest.mark.parametrize("case", SPLIT_CASES)
def test_any_split_gives_the_same_points_and_counts(case):
    rng = np.random.default_rng(SEED)
    stream, modulation, settings = SPLIT_CASES[case]
    whole, a = reconstruct(stream, modulation, settings)
    assert len(whole) > 1000
    assert (a.counters["events_gated"] > 0) == ("gate" in case)
    random_cuts = [rng.integers(0, len(stream), size).tolist() for size in (1, 5, 40)]
    for cuts in (*random_cuts, range(37, len(stream), 997)):
        parts, b = reconstruct(stream, modulation, settings, cuts)
        assert_same(whole, parts)
        assert a.counters == b.counters


@pytest.mark.parametrize("case", [*SPLIT_CASES, "returns", "compensation"])
def test_threads_give_the_same_points_and_counts(case, monkeypatch):
    """With windows of a few periods each, so that there are many, in a stream with faults too."""
    monkeypatch.setattr(profile_rows, "WINDOW_EVENTS", 20_000)
    monkeypatch.setattr(reconstructor, "PASS_WORDS", 1 << 14)
    monkeypatch.setattr(reconstructor, "_PIECE_WORDS", 1 << 12)
    rng = np.random.default_rng(SEED)
    more = {"returns": {"returns": "all"}, "compensation": {"reflectance_compensation": "on"}}
    stream, modulation, settings = SPLIT_CASES.get(case, SPLIT_CASES["edge"])
    settings = replace(settings, **more.get(case, {}))
    faulty = np.frombuffer(stream, "<u2").copy()
    faulty[rng.integers(0, faulty.size, 40)] = rng.integers(0, 1 << 16, 40)
    for data in (stream, faulty.tobytes()):
        half = len(data) // 2 + 1
        serial, a = reconstruct(data, modulation, settings, [half])
        stage_edges = a.take_stage_edges()
        for jobs in (2, 5):
            parallel = Reconstructor(CALIBRATION, modulation, settings, jobs)
            parts = [parallel.push(data[k : k + half]) for k in range(0, len(data), half)]
            assert_same(serial, Profiles.concatenate([*parts, parallel.flush()]))
            assert a.counters == parallel.counters
            for one, other in zip(stage_edges, parallel.take_stage_edges(), strict=True):
                np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("case", ["estimate", "drift", "stage", "trigger"])
def test_threads_work_where_events_or_triggers_show_the_phase(case, monkeypatch):
    monkeypatch.setattr(profile_rows, "WINDOW_EVENTS", 20_000)
    monkeypatch.setattr(reconstructor, "PASS_WORDS", 1 << 14)
    monkeypatch.setattr(reconstructor, "_PIECE_WORDS", 1 << 12)
    assemble, merge = windows.WindowAssembler._assemble, windows.WindowAssembler.merge_words
    threads, sizes = Counter(), []

    def counted(self, begin, decoder, assembler):
        before = assembler.counters["events_binned"]
        result = assemble(self, begin, decoder, assembler)
        threads[threading.get_ident()] += assembler.counters["events_binned"] - before
        return result

    def measured(self, words, *others):
        sizes.append(words.size)
        return merge(self, words, *others)

    monkeypatch.setattr(windows.WindowAssembler, "_assemble", counted)
    monkeypatch.setattr(windows.WindowAssembler, "merge_words", measured)
    stream, modulation, settings = SPLIT_CASES[case]
    parallel = Reconstructor(CALIBRATION, modulation, settings, 2)
    parallel.push(stream)
    threads.pop(threading.get_ident(), None)
    assert threads.total() > 0.5 * parallel.counters["events"], f"seed {SEED}"
    # In small pieces threads would wait for each other.
    assert 2 * max(sizes) > 0.5 * len(stream), f"seed {SEED}"


def test_lines_have_their_usual_width_where_a_gate_changes(monkeypatch):
    """With windows of two or three profiles, each of which learns the gate."""
    monkeypatch.setattr(profile_rows, "WINDOW_EVENTS", 20_000)
    found, _ = reconstruct(*SPLIT_CASES["learned gate"])
    assert np.mean(found.flags > 0) < 0.02, f"seed {SEED}"


def test_later_windows_learn_the_gate_of_the_first(monkeypatch):
    """The narrow width of its lines leaves out late events, too, so a gate seems to gain less."""
    case = SPLIT_CASES["learned gate"]
    _, one = reconstruct(*case)
    monkeypatch.setattr(profile_rows, "WINDOW_EVENTS", 20_000)
    _, many = reconstruct(*case)
    gated = [reconstructor.counters["events_gated"] for reconstructor in (one, many)]
    assert gated[1] > 0.9 * gated[0], f"seed {SEED}: {gated}"


def test_threads_go_on_with_the_footprint_that_the_first_window_has_learned(monkeypatch):
    """Learned in 10 profiles of 60, with windows of a dozen; half of the events are lost."""
    monkeypatch.setattr(profile_rows, "WINDOW_EVENTS", 400_000)
    camera = Camera(periods=60)
    events = camera.line(wavy)
    kept = camera.rng.random(events[0].size) < 0.5
    data = stream(tuple(values[kept] for values in events))
    modulation = Modulation(camera.frequency_hz, on_edge_us=FIRST_EDGE_US)
    learned = Settings(centroid="learned")
    serial, a = reconstruct(data, modulation, learned)
    means, _ = reconstruct(data, modulation, Settings(detail="off"))
    late = serial.period > 12
    assert np.mean(serial.row[~late] == means.row[~late]) > 0.5
    assert np.mean(serial.row[late] == means.row[late]) < 0.1
    for jobs in (2, 5):
        parallel = Reconstructor(CALIBRATION, modulation, learned, jobs)
        parts = [parallel.push(data), parallel.flush()]
        assert_same(serial, Profiles.concatenate(parts))
        assert a.counters == parallel.counters


def test_windows_are_found_without_decoding_what_is_before_them(monkeypatch):
    """None but the first, which learns, is assembled by itself, behind the one before it."""
    monkeypatch.setattr(profile_rows, "WINDOW_EVENTS", 30_000)
    alone = windows.WindowAssembler._go_on
    learns = []

    def go_on(self):
        learns.append(self._open.is_learning)
        return alone(self)

    monkeypatch.setattr(windows.WindowAssembler, "_go_on", go_on)
    stream, modulation, settings = SPLIT_CASES["edge"]
    parallel = Reconstructor(CALIBRATION, modulation, settings, 2)
    found = Profiles.concatenate(
        [parallel.push(stream[:2000]), parallel.push(stream[2000:]), parallel.flush()]
    )
    assert_same(found, reconstruct(stream, modulation, settings)[0])
    assert parallel.counters["events"] > 4 * 30_000
    assert learns == [True]


def test_a_time_low_that_the_sensor_takes_back_may_end_a_piece():
    """The word and its correction in two packets: nothing is closed early, nothing is late."""
    words = np.frombuffer(encoded(lines(frequency_hz=5000.0, periods=30, columns=80)), "<u2")
    places = np.flatnonzero(words >> 12 == 6)[50::200]
    stream = np.insert(words, places, 0x6FFF)
    cuts = 2 * (places + np.arange(1, len(places) + 1))
    modulation = Modulation(5000.0, on_edge_us=1000)
    whole, a = reconstruct(stream.tobytes(), modulation)
    parts, b = reconstruct(stream.tobytes(), modulation, None, cuts.tolist())
    plain, _ = reconstruct(words.tobytes(), modulation)
    assert len(cuts) > 10
    assert_same(whole, plain)
    assert_same(whole, parts)
    assert a.counters == b.counters


def test_a_time_high_that_steps_back_reopens_no_period():
    words = np.frombuffer(encoded(lines(frequency_hz=5000.0, periods=100, columns=40)), "<u2")
    place = np.flatnonzero(words >> 12 == 8)[2] + 1
    high = words[place - 1]
    ahead = np.insert(words, place, [high + 2, high])
    known = Modulation(5000.0, on_edge_us=1000)
    found, _ = reconstruct(ahead.tobytes(), known, None, [2 * (place + 1)])
    since_us = found.t_us - found.edge_us
    assert since_us.min() >= 0
    assert since_us.max() < 200


@pytest.mark.parametrize("first", [6, 8, 10, 12])
def test_triggers_that_begin_after_the_phase_was_estimated_are_not_moved(first):
    """However the data come: the block in which the phase is set ends without correction."""
    modulation = Modulation(1e6 / 3000)
    edges = 5000 + np.arange(first, 20) * 3000 - 150
    events = lines(frequency_hz=modulation.frequency_hz, periods=20, columns=60, edge_us=5000)
    stream = encoded(events, edges[:2])
    whole, a = reconstruct(stream, modulation)
    parts, b = reconstruct(stream, modulation, None, range(0, len(stream), 2048))
    assert_same(whole, parts)
    assert a.counters == b.counters
    late = np.unique(whole.edge_us[whole.edge_us >= edges[1]])
    np.testing.assert_array_equal(late, edges[1:][: late.size])


def test_triggers_before_the_first_edge_of_a_known_phase_lose_no_period(monkeypatch):
    """In one piece as in many: events before the first edge are of no profile."""
    modulation = Modulation(70.0, on_edge_us=1_000_000 - 60_000)
    edges = np.rint(1_000_000 + np.arange(20) * 1e6 / 70).astype(int)
    stream = encoded(lines(periods=20, columns=60, edge_us=1_000_000), edges)
    settings = Settings(periods_per_profile=10)
    parts, a = reconstruct(stream, modulation, settings, range(0, len(stream), 512))
    monkeypatch.setattr(reconstructor, "_PIECE_WORDS", 1 << 11)
    whole, b = reconstruct(stream, modulation, settings)
    assert_same(parts, whole)
    assert a.counters == b.counters
    assert whole.edge_us.min() > edges[0]


def test_triggers_after_the_last_event_are_not_its_time(monkeypatch):
    monkeypatch.setattr(reconstructor, "_PIECE_WORDS", 1 << 12)
    edges = 1000 + np.arange(60) * 2000
    events = lines(frequency_hz=500.0, periods=40, columns=60)
    stream = encoded(events, edges)
    _, whole = reconstruct(stream, Modulation(500.0))
    _, parts = reconstruct(stream, Modulation(500.0), None, range(0, len(stream), 2048))
    assert whole.newest_t_us == parts.newest_t_us == events[0][-1]
    assert whole.counters == parts.counters


@pytest.mark.parametrize("every", [2, 3, 7])
def test_a_profile_of_several_periods_after_a_long_dark_stretch_has_its_own_time(every):
    """Wherever in the profile's count the stretch of more than 4096 periods begins."""
    modulation = Modulation(5000.0, on_edge_us=1000)
    settings = Settings(periods_per_profile=every)
    t, x, y, p = lines(frequency_hz=5000.0, periods=40, columns=60)
    for shift in range(every):
        later = t >= 1000 + (20 + shift) * 200
        stream = encoded((t + later * (1_500_000 + 200 * shift), x, y, p))
        found, _ = reconstruct(stream, modulation, settings, range(0, len(stream), 512))
        since_us = found.t_us - found.edge_us
        assert since_us.min() >= 0
        assert since_us.max() < every * 200, f"seed {SEED}, shift {shift}"


def test_step_scene_invents_nothing_between_the_surfaces():
    def step(k, c):
        return np.where((c // 100) % 2 == 0, 300.0, 360.0)

    found, _ = reconstruct(encoded(lines(step, events=60.0, fwhm_px=5.0)))
    truth = step(0, found.column.astype(int))
    assert np.abs(found.row - truth).max() < 3.0


def test_slope_is_unbiased():
    slope = lines(lambda k, c: 100 + 0.4 * c, events=80.0, fwhm_px=6.0)
    found, _ = reconstruct(encoded(slope))
    error = found.row - (100 + 0.4 * found.column)
    inner = (found.column > 5) & (found.column < 1274)
    independent = inner.sum() / 5
    assert abs(error[inner].mean()) < 4 * error.std() / np.sqrt(independent), f"seed {SEED}"


def test_second_surface_appears_and_the_seed_is_not_stale():
    jump = lines(lambda k, c: np.full(c.shape, 500.0 if k >= 5 else 200.0), events=30.0)
    found, _ = reconstruct(encoded(jump))
    truth = np.where(found.period >= 5, 500.0, 200.0)
    assert np.abs(found.row - truth).max() < 20
    assert len(found) > 0.98 * 10 * 1280


@pytest.mark.parametrize("row", [0.0, 719.0])
def test_line_at_the_edge_of_the_sensor(row):
    line = lines(lambda k, c: np.full(c.shape, row), events=60.0, columns=200)
    found, _ = reconstruct(encoded(line), settings=RAW)
    assert len(found) > 0.95 * 10 * 200
    assert np.abs(found.row - row).max() < 20
    assert np.mean(np.abs(found.row - row) < 2 * found.sigma_row) > 0.95


def test_one_event_and_constant_columns():
    t, x, y = (np.array([one] + [more] * 20) for one, more in ((2000, 3000), (5, 9), (300, 400)))
    events = sort_readout(t + np.arange(21), x, y, np.ones(21, int))
    found, _ = reconstruct(encoded(events), settings=Settings(events_min=1, isolation_events=0))
    assert found.column.tolist() == [5, 9]
    assert found.row.tolist() == [300.0, 400.0]
    expected = np.sqrt(1 / 12 + SIGMA_FLOOR_PX**2)
    np.testing.assert_allclose(found.sigma_row, expected)
    assert found.t_us.tolist() == [2000, 3010]


def test_events_over_the_column_limit_are_counted():
    events = lines(columns=50, events=100.0, periods=4)
    found, reconstructor = reconstruct(encoded(events), settings=Settings(column_limit=64))
    assert len(found) == 4 * 50
    assert found.events.max() <= 64
    expected = sum(
        max(n - 64, 0)
        for k in range(4)
        for n in np.bincount(events[1][(events[0] - 1000) // 14286 == k])
    )
    assert reconstructor.counters["events_over_column_limit"] == pytest.approx(expected, rel=0.01)
    (warning,) = reconstructor.warnings
    assert "column_limit drops 36% of the events, the last ones of a profile; raise it" in warning


def test_jittered_and_missing_triggers_lose_no_event():
    rng = np.random.default_rng(SEED)
    jitter = np.cumsum(rng.integers(-30, 31, 20))
    edges = 50_000 + np.rint(np.arange(20) * 1e6 / 70).astype(int) + jitter
    parts = [line_events(rng, flat, periods=1, edge_us=int(edge), background=0.0) for edge in edges]
    events = tuple(np.concatenate(values) for values in zip(*parts, strict=True))
    data = encoded(sort_readout(*events), np.delete(edges, [7, 8]))
    found, reconstructor = reconstruct(data, Modulation(70.0))
    assert found.profile_count == 20
    kept = np.unique(found.edge_us)
    np.testing.assert_array_equal(np.delete(kept, [7, 8]), np.delete(edges, [7, 8]))
    assert reconstructor.counters["edges_bridged"] == 2
    assert reconstructor.counters["events_binned"] == len(events[0])
    per_period = [int(np.sum(found.events[found.edge_us == e])) for e in kept]
    expected = [len(part[0]) for part in parts]
    np.testing.assert_allclose(per_period, expected, rtol=0.02)
    assert not reconstructor.warnings


@pytest.mark.parametrize(
    ("edges", "words"),
    [
        (np.array([81_000, 202_000, 267_000]), "0 of 3 edges at the trigger input"),
        (np.arange(1000, 280_000, 2000), "0 of 140 edges at the trigger input"),
    ],
)
def test_edges_on_the_trigger_input_that_are_not_the_lasers_have_a_warning(edges, words):
    rng = np.random.default_rng(SEED)
    data = encoded(line_events(rng, flat, periods=20), edges)
    _, reconstructor = reconstruct(data, Modulation(70.0))
    assert any(words in warning for warning in reconstructor.warnings)


@pytest.mark.parametrize(
    ("lit", "triggers", "words"),
    [(10, 10, []), (30, 10, ["10 of 10 edges at the trigger input", "20 periods with points"])],
)
def test_triggers_that_end_with_the_light_are_no_fault(lit, triggers, words):
    rows = lines(lambda k, c: np.where(k < lit, 350.0, np.nan), periods=40)
    edges = 1000 + np.rint(np.arange(triggers) * 1e6 / 70).astype(int)
    found, reconstructor = reconstruct(encoded(rows, edges), Modulation(70.0))
    assert found.profile_count == lit
    assert len(reconstructor.warnings) == bool(words)
    assert all(word in reconstructor.warnings[0] for word in words)


def test_phase_is_estimated_and_nothing_is_lost():
    found, reconstructor = reconstruct(encoded(lines(periods=8, edge_us=9000)), Modulation(70.0))
    assert not reconstructor.phase_missing
    error = (found.edge_us[0] - 9000 + 7143) % (1e6 / 70) - 7143
    assert abs(error) < 700
    assert reconstructor.counters["events_outside_phase"] == 0
    assert len(found) > 0.98 * 8 * 1280


def noise(count, until_us):
    rng = np.random.default_rng(SEED)
    return tuple(rng.integers(0, below, count) for below in (until_us, 1280, 720, 2))


def test_noise_before_the_laser_is_kept_back_and_the_phase_still_found():
    lit = lines(periods=8, edge_us=500_000)
    both = zip(noise(30_000, 500_000), lit, strict=True)
    data = encoded(sort_readout(*(np.concatenate(values) for values in both)))
    found, reconstructor = reconstruct(data, Modulation(70.0))
    assert not reconstructor.phase_missing
    assert np.count_nonzero(found.t_us > 500_000) > 0.98 * 8 * 1280


def test_a_phase_that_is_found_after_a_flush_without_one_has_no_warning():
    """A scan in the dark before one with light."""
    reconstructor = Reconstructor(CALIBRATION, Modulation(70.0))
    reconstructor.push(encoded(sort_readout(*noise(3000, 80_000))))
    reconstructor.flush()
    assert reconstructor.phase_missing
    found = reconstructor.push(encoded(lines(periods=8, edge_us=500_000)))
    assert len(found) + len(reconstructor.flush()) > 0.8 * 8 * 1280
    assert not reconstructor.phase_missing
    assert not any("no modulation" in warning for warning in reconstructor.warnings)


def test_events_without_a_phase_give_nothing_and_are_counted():
    n = 3000
    found, reconstructor = reconstruct(encoded(sort_readout(*noise(n, 80_000))), Modulation(70.0))
    assert reconstructor.phase_missing
    assert reconstructor.counters["events_outside_phase"] == n
    assert any("no modulation at 70 Hz" in warning for warning in reconstructor.warnings)
    assert len(found) == 0


def test_flush_twice_and_pushing_on():
    events = lines(periods=6, columns=100)
    encoder = Encoder()
    cut = int(np.searchsorted(events[0], 1000 + 3 * 1e6 / 70))
    first = encoder.encode(*(values[:cut] for values in events))
    second = encoder.encode(*(values[cut:] for values in events))
    reconstructor = Reconstructor(CALIBRATION, KNOWN)
    a = Profiles.concatenate([reconstructor.push(first), reconstructor.flush()])
    assert len(reconstructor.flush()) == 0
    b = Profiles.concatenate([reconstructor.push(second), reconstructor.flush()])
    whole, _ = reconstruct(first + second)
    assert_same(Profiles.concatenate([a, b]), whole)


def test_gap_keeps_the_grid():
    data = encoded(lines(columns=300))
    whole, _ = reconstruct(data)
    reconstructor = Reconstructor(CALIBRATION, KNOWN)
    half = len(data) // 2 & ~1
    parts = [reconstructor.push(data[: half - 4000])]
    reconstructor.note_gap()
    parts += [reconstructor.push(data[half:]), reconstructor.flush()]
    found = Profiles.concatenate(parts)
    assert np.isin(found.edge_us, whole.edge_us).all()
    assert len(found) > 0.85 * len(whole)


def test_new_modulation_starts_a_new_grid():
    slow = lines(periods=4, columns=100)
    fast = lines(frequency_hz=500.0, periods=8, columns=100, edge_us=100_000)
    encoder = Encoder()
    reconstructor = Reconstructor(CALIBRATION, KNOWN)
    parts = [reconstructor.push(encoder.encode(*slow))]
    reconstructor.set_modulation(Modulation(500.0, on_edge_us=100_000))
    parts += [reconstructor.push(encoder.encode(*fast)), reconstructor.flush()]
    found = Profiles.concatenate(parts)
    assert found.profile_count == 12
    assert np.isin(found.edge_us[found.edge_us >= 100_000] - 100_000, np.arange(8) * 2000).all()


def test_several_periods_per_profile():
    wave, settings = Modulation(10_000.0, on_edge_us=0), Settings(periods_per_profile=50)
    sparse = {"periods": 200, "columns": 200, "events": 1.0, "fwhm_px": 4.0, "edge_us": 0}
    found, _ = reconstruct(encoded(lines(frequency_hz=10_000.0, **sparse)), wave, settings)
    assert np.unique(found.edge_us).tolist() == [0, 5000, 10_000, 15_000]
    assert np.unique(found.period).tolist() == [0, 50, 100, 150]
    assert np.abs(found.row - 350).max() < 3


@pytest.mark.parametrize("phase", ["known", "estimated", "too fast for the pixels"])
def test_a_profile_has_as_many_periods_as_give_points(phase):
    """1.5 events per column and period, with background from 50 ms before."""
    rng = np.random.default_rng(SEED)
    fast = {"periods": 3000, "columns": 300, "events": 1.5, "fwhm_px": 4.0, "edge_us": 50_000}
    line = lines(frequency_hz=20_000.0, background=0.0, **fast)
    if phase == "too fast for the pixels":
        line = np.sort(rng.integers(50_000, 200_000, line[0].size)), *line[1:]
    t_us = np.sort(rng.integers(0, 200_000, 20_000))
    noise = t_us, *rng.integers(0, 300, (2, t_us.size)), t_us % 2
    stream = encoded(sort_readout(*(np.concatenate(v) for v in zip(line, noise, strict=True))))
    modulation = Modulation(20_000.0, on_edge_us=None if phase == "estimated" else 50_000)
    found, whole = reconstruct(stream, modulation)
    every = whole.periods_per_profile
    assert every in (10, 11), f"seed {SEED}"
    lit = found.select(found.edge_us >= 50_000)
    assert len(lit) > 0.9 * 300 * 3000 / every
    assert np.median(np.abs(lit.row - 350)) < 1.0
    assert f"{every} periods make a profile" in " ".join(whole.warnings)
    parts, split = reconstruct(stream, modulation, None, rng.integers(0, len(stream), 30).tolist())
    assert_same(found, parts)
    assert whole.counters == split.counters
    assert_same(found, reconstruct(stream, modulation, Settings(periods_per_profile=every))[0])


def test_a_dense_stream_gives_profiles_after_a_window_and_two_periods():
    reconstructor = Reconstructor(CALIBRATION, KNOWN)
    found = reconstructor.push(encoded(lines(periods=8)))
    assert found.profile_count >= 6, f"seed {SEED}"
    assert reconstructor.periods_per_profile == 1


@pytest.mark.parametrize(("jump_px", "every"), [(0.0, 1), (3.0, 2)])
def test_profiles_have_as_many_periods_as_show_the_same_rows(jump_px, every):
    """Pixels whose refractory time is longer than a period answer in turns."""
    rng = np.random.default_rng(SEED)
    line = line_events(
        rng,
        lambda k, c: 350.0 + jump_px * (-1.0) ** k + 0.0 * c,
        frequency_hz=20_000.0,
        periods=600,
        columns=300,
        events=30.0,
        background=0.0,
    )
    found, reconstructor = reconstruct(encoded(line), Modulation(20_000.0))
    assert reconstructor.periods_per_profile == every, f"seed {SEED}"
    assert np.median(np.abs(found.row - 350.0)) < 1.0
    assert any("or others in the next" in line for line in reconstructor.warnings) == (every > 1)


def test_a_long_dark_stretch_does_not_choose_the_periods_of_a_profile(monkeypatch):
    monkeypatch.setattr(profile_length, "HELD_EVENTS_MAX", 20_000)
    rng = np.random.default_rng(SEED)
    n = 100_000
    dark = np.sort(rng.integers(0, 400_000, n)), rng.integers(0, 1280, n), rng.integers(0, 720, n)
    line = line_events(
        rng, flat, frequency_hz=5000.0, periods=3000, columns=300, events=1.5, edge_us=400_000
    )
    noise = (*dark, rng.integers(0, 2, n))
    events = (np.concatenate(pair) for pair in zip(noise, line, strict=True))
    found, reconstructor = reconstruct(encoded(tuple(events)), Modulation(5000.0))
    assert reconstructor.periods_per_profile in (10, 11), f"seed {SEED}"
    assert reconstructor.counters["events_outside_phase"] > 50_000
    assert len(found) > 0.9 * 300 * 3000 / 11


def test_a_flash_before_the_laser_does_not_choose_the_periods_of_a_profile():
    flash = lines(periods=2, columns=200, events=20.0, background=0.0)
    laser = lines(periods=40, columns=200, events=20.0, background=0.0, edge_us=3_000_000)
    rng = np.random.default_rng(SEED)
    t_us = np.sort(rng.integers(0, 3_500_000, 150_000))
    noise = t_us, rng.integers(0, 200, t_us.size), rng.integers(0, 720, t_us.size), t_us % 2
    stream = encoded(
        sort_readout(*(np.concatenate(v) for v in zip(flash, laser, noise, strict=True)))
    )
    found, whole = reconstruct(stream, KNOWN)
    assert whole.periods_per_profile == 1, f"seed {SEED}"
    assert len(found.select(found.edge_us >= 3_000_000)) > 0.95 * 200 * 40


def test_the_region_of_interest_keeps_the_points_inside_and_counts_the_events_outside():
    slope = lines(lambda k, c: 100 + 0.4 * c, events=60.0, fwhm_px=6.0, background=0.05)
    near_mm, far_mm = MODEL.range_mm([250.0, 450.0])
    whole, a = reconstruct(encoded(slope), settings=RAW)
    region = {"column_first": 300, "column_last": 800, "range_min": near_mm * 1e-3}
    part, b = reconstruct(encoded(slope), settings=replace(RAW, range_max=far_mm * 1e-3, **region))
    inside = (whole.column >= 300) & (whole.column <= 800)
    expected = whole.select(inside & (whole.range_mm >= near_mm) & (whole.range_mm <= far_mm))
    assert len(part) == pytest.approx(len(expected), abs=0.005 * len(expected))
    assert part.column.min() >= 300
    assert near_mm <= part.range_mm.min() < part.range_mm.max() <= far_mm
    error, before = (np.abs(v.row - 100 - 0.4 * v.column) for v in (part, expected))
    assert error.mean() <= 1.01 * before.mean(), f"seed {SEED}"
    assert b.counters["events_outside_roi"] > 0.5 * b.counters["events"]
    assert a.counters["events_outside_roi"] == 0


def test_a_camera_that_sends_the_regions_window_gives_the_same_points():
    t, x, y, p = lines(lambda k, c: 100 + 0.4 * c, events=60.0, fwhm_px=6.0, background=0.05)
    near_mm, far_mm = MODEL.range_mm([250.0, 450.0])
    settings = replace(RAW, column_first=300, column_last=800, range_min=near_mm * 1e-3,
                       range_max=far_mm * 1e-3)  # fmt: skip
    left, top, width, height = region_window(settings, MODEL)
    assert (left, width) == (300, 501)
    assert height < 300
    seen = (left <= x) & (x < left + width) & (top <= y) & (y < top + height)
    whole, _ = reconstruct(encoded((t, x, y, p)), KNOWN, settings)
    part, counted = reconstruct(encoded((t[seen], x[seen], y[seen], p[seen])), KNOWN, settings)
    np.testing.assert_array_equal(part.row, whole.row)
    assert len(part) > 1000, f"seed {SEED}"
    assert counted.counters["events"] < 0.5 * x.size
    assert region_window(RAW, MODEL) == (0, 0, MODEL.columns, MODEL.rows)
    beside = replace(RAW, column_first=2000)
    assert region_window(beside, MODEL) == (0, 0, MODEL.columns, MODEL.rows)


def test_twenty_kilohertz_periods_are_closed_without_loss():
    fast = {"periods": 2000, "columns": 20, "events": 10.0, "fwhm_px": 3.0, "edge_us": 0}
    data = encoded(lines(frequency_hz=20_000.0, **fast))
    found, _ = reconstruct(data, Modulation(20_000.0, on_edge_us=0))
    assert found.profile_count == 2000


def test_weak_isolated_points_are_rejected():
    events = lines(lambda k, c: np.where(c < 100, 300.0, np.nan), background=0.0)
    lone = (5000 + np.arange(6), np.full(6, 700), np.full(6, 500), np.ones(6, int))
    data = encoded(sort_readout(*(np.concatenate(v) for v in zip(events, lone, strict=True))))
    found, reconstructor = reconstruct(data)
    assert not (found.column == 700).any()
    assert reconstructor.counters["columns_isolated"] == 1


def test_placing():
    found, _ = reconstruct(encoded(lines(periods=2)))
    position = np.full(len(found), 12.0)
    position[3] = np.nan
    points = place(found, MODEL, position, (0.0, 1.0, 0.0), origin_us=1000)
    assert len(points) == len(found) - 1
    np.testing.assert_allclose(points["y"], 0.012, rtol=1e-6)
    link = place_link(found, MODEL, origin_us=1000)
    assert (link["y"] == 0).all()
    np.testing.assert_allclose(link["x"], found.range_mm * 1e-3, rtol=1e-6)
    z_m = MODEL.lateral_mm(found.column, found.range_mm) * 1e-3
    np.testing.assert_allclose(link["z"], z_m, atol=1e-7)
    np.testing.assert_array_equal(link["t"], (found.t_us - 1000) * 1e-6)


def test_what_does_not_match_the_points_is_refused():
    found, _ = reconstruct(encoded(lines(periods=2)))
    points, direction = place_link(found, MODEL), (0.0, 1.0, 0.0)
    for wrong in (np.zeros(len(found) - 1), np.zeros(1)):
        with pytest.raises(ArgumentError, match="position_mm"):
            add_stage(points, wrong, direction)
    with pytest.raises(ArgumentError, match="range_mm"):
        place_link(replace(found, range_mm=found.range_mm[1:]), MODEL)
    with pytest.raises(ArgumentError, match="give the model"):
        place(found, CALIBRATION, 0.0, direction)


def test_settings_describe_themselves_and_refuse_bad_values():
    for item in fields(Settings):
        assert item.metadata["description"]
        if "choices" in item.metadata:
            bad = "nonsense"
        else:
            low, high = item.metadata["range"]
            assert low <= item.default <= high
            bad = high + 1
        with pytest.raises(ArgumentError) as caught:
            Settings(**{item.name: bad})
        assert item.name in str(caught.value)
    with pytest.raises(ArgumentError):
        Reconstructor(CALIBRATION, Modulation(16.0), Settings(periods_per_profile=1000))


def test_a_computer_with_more_cores_than_threads_may_be_reconstructs(tmp_path, monkeypatch):
    narrow = replace(CALIBRATION, columns=16, principal_column=None)
    scene, modulation = Plane(1320.0), Modulation(70.0)
    recording = simulate_recording(tmp_path, scene, narrow, modulation, 10.0, 12.0, 20.0, SEED)
    one = reconstruct_recording(recording, jobs=1)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(1000))
    assert reconstruct_recording(recording).points.tobytes() == one.points.tobytes()
