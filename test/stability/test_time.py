"""Hard cases 7, 8, 9, 10, 20 and 21: clocks that wrap, run for decades, or come out of order."""

from fractions import Fraction

import mpmath
import numpy as np
import pytest
from line_events import blank_profiles, encoded, line_events
from reconstructing import CALIBRATION, assert_same, reconstruct
from stage_pulses import PULSES, StagePulses

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.clocks import ClockLine, SensorClock, StageTrack, fit_edges
from eschorty_ros.core.evt3 import ActivityFilter, Decoder, Encoder, Events, Triggers, sort_readout
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.modulation.edges import EdgeSchedule
from eschorty_ros.core.modulation.phase_estimate import estimate_phase
from eschorty_ros.core.reconstruction import Profiles, Settings, paper_method, place
from eschorty_ros.core.reconstruction import reconstructor as reconstructor_module

SEED = 7
EPOCH_US = 1_760_000_000_000_000
FREQUENCY_HZ = 69.99731
MODEL = CALIBRATION.model()
ALL_EVENTS = Settings(centroid="mean", smoothing_half_width=0, isolation_events=0)
WRAP_EVT3_US = 1 << 24
WRAP_INT32_US = 1 << 31
WRAP_EVT2_US = 1 << 34
HOUR_US = 3_600_000_000


def flat(period, column):
    return np.full(column.shape, 350.0)


def reconstructed(data: bytes, modulation: Modulation) -> Profiles:
    return reconstruct(data, modulation, ALL_EVENTS)[0]


class LateDecoder(Decoder):
    """A camera that has been on for 54 years."""

    shift_us = 101_328_000 * WRAP_EVT3_US

    def __init__(self, *size):
        super().__init__(*size)
        self.decode(b"\x00\x80")
        self.memory.state["epoch_us"] += self.shift_us
        self.memory.state["floor_us"] += self.shift_us


@pytest.mark.hard_case(7)
def test_decades_of_microseconds_give_the_same_profiles(monkeypatch):
    rng = np.random.default_rng(SEED)
    data = encoded(line_events(rng, flat, frequency_hz=FREQUENCY_HZ, periods=6, columns=200))
    near = reconstructed(data, Modulation(FREQUENCY_HZ, on_edge_us=1000))
    monkeypatch.setattr(reconstructor_module, "Decoder", LateDecoder)
    shift = LateDecoder.shift_us
    far = reconstructed(data, Modulation(FREQUENCY_HZ, on_edge_us=1000 + shift))
    np.testing.assert_array_equal(near.row, far.row)
    np.testing.assert_array_equal(near.t_us + shift, far.t_us)
    np.testing.assert_array_equal(near.edge_us + shift, far.edge_us)
    old_edge = reconstructed(data, Modulation(FREQUENCY_HZ, on_edge_us=1000))
    assert (old_edge.t_us >= old_edge.edge_us).all()


@pytest.mark.hard_case(7)
def test_conversion_to_ros_time_is_exact_at_1e18_ns(measured):
    """Floats would round to 256 ns here."""
    t_us = EPOCH_US + np.random.default_rng(SEED).integers(0, 10**12, 2000)
    clock = SensorClock(zero_ns=123_456_789)
    exact = [int(t) * 1000 + 123_456_789 for t in t_us]
    worst = max(abs(int(a) - b) for a, b in zip(clock.to_ns(t_us), exact, strict=True))
    measured("sensor time to ROS time, ns", worst, 0)
    np.testing.assert_array_equal(clock.to_us(clock.to_ns(t_us)), t_us)
    with pytest.raises(ArgumentError, match="float64"):
        clock.to_ns(t_us.astype(np.float64))


@pytest.mark.parametrize("uptime_us", [WRAP_EVT3_US, WRAP_INT32_US, WRAP_EVT2_US, EPOCH_US])
@pytest.mark.hard_case(7)
def test_a_clock_from_edges_is_the_same_after_any_uptime(uptime_us, measured):
    """ROS time of 54 years, sensor time up to as much: floats would round both."""
    bench = StagePulses((10.0, 210.0, 10.0))
    near = fit_edges(bench.edges, bench.track, PULSES, bench.arrivals(3.0))
    arrivals = bench.arrivals(3.0)
    late = ClockLine(arrivals.origin_us + uptime_us, arrivals.origin_ns, arrivals.drift_ppb)
    far = fit_edges(bench.edges + uptime_us, bench.track, PULSES, late)
    t_us = bench.edges[0] + np.arange(0, 2_000_000, 997)
    worst_ns = np.abs(far.line.to_ns(t_us + uptime_us) - near.line.to_ns(t_us)).max()
    measured("clock from edges after a long uptime, ns", worst_ns, 1)
    measured("position by that clock at 300 mm/s, um", bench.error_um(near), 10.0)


@pytest.mark.hard_case(7)
def test_points_count_time_from_their_origin(measured):
    n = 2000
    t_us = EPOCH_US + np.arange(n) * 997
    points = place(blank_profiles(n, t_us=t_us), MODEL, 0.0, (0.0, 1.0, 0.0), EPOCH_US)
    error = np.abs(points["t"] - np.arange(n) * 997 / 1e6).max()
    measured("time of points since the origin, s", error, 1e-15)


@pytest.mark.hard_case(7)
def test_phase_of_events_is_that_of_the_same_events_at_zero(measured):
    rng = np.random.default_rng(SEED)
    t, _, _, p = line_events(rng, flat, frequency_hz=FREQUENCY_HZ, columns=60)
    near = estimate_phase(t, p, Modulation(FREQUENCY_HZ))
    far = estimate_phase(t + EPOCH_US, p, Modulation(FREQUENCY_HZ))
    measured("edge found at 1.76e15 us, us", abs(far.edge_us - EPOCH_US - near.edge_us), 0)
    assert far.strength == near.strength


@pytest.mark.parametrize("origin_us", [0, EPOCH_US])
@pytest.mark.hard_case(8)
def test_phase_against_50_digits(origin_us, measured):
    """Vector strength over a minute, which every phase enters; float f t is off by 1.6e-6."""
    n = 2000
    t = origin_us + np.sort(np.random.default_rng(SEED).integers(0, 60_000_000, n))
    ours = estimate_phase(t, np.ones(n, np.uint8), Modulation(FREQUENCY_HZ)).strength
    with mpmath.workdps(50):
        f = mpmath.mpf(FREQUENCY_HZ)
        turns = [f * int(tick - t[0]) / 10**6 for tick in t]
        exact = abs(mpmath.fsum(mpmath.expjpi(2 * turn) for turn in turns)) / n
    measured("vector strength over a minute (mean phase, turns)", abs(ours - exact), 1e-12)


@pytest.mark.parametrize(
    ("origin_us", "after_us"), [(0, HOUR_US), (EPOCH_US, HOUR_US), (0, 10**15)]
)
@pytest.mark.hard_case(8)
def test_edges_are_the_exact_quotient(origin_us, after_us, measured):
    """Long after the last sync edge each edge is the nearest microsecond, exactly."""
    schedule = EdgeSchedule(Modulation(FREQUENCY_HZ))
    schedule.anchor(origin_us, origin_us)
    schedule.jump(origin_us + after_us)
    edges, indices = schedule.advance(origin_us + after_us + 10_000_000)
    period = 1_000_000 / Fraction(FREQUENCY_HZ)
    assert 500 < edges.size < 1000
    exact = [origin_us + round(int(k) * period) for k in indices]
    worst = max(abs(int(edge) - true) for edge, true in zip(edges, exact, strict=True))
    measured("edges long after the sync edge, us", worst, 0)


def stream_across(wrap_us: int, disorder_us: int) -> tuple[np.ndarray, bytes]:
    """Times around a wrap as a sensor sends them, TIME_HIGH and TIME_LOW for every event.

    With disorder an event's time may lie before the one sent before it.
    """
    rng = np.random.default_rng(SEED)
    order = wrap_us - 100_000 + np.cumsum(rng.integers(1, 60, 7000))
    sent = order + rng.integers(-disorder_us, disorder_us + 1, order.size)
    words, high = [], None
    for k, t in enumerate(sent):
        if t >> 12 != high:
            high = t >> 12
            words.append(0x8000 | high & 0xFFF)
        words += [0x6000 | t & 0xFFF, k % 720, 0x2000 | k % 1280]
    return sent, np.array(words, "<u2").tobytes()


@pytest.mark.parametrize("chunk", [1 << 20, 4096, 6, 1])
@pytest.mark.parametrize("disorder_us", [0, 10])
@pytest.mark.hard_case(9)
def test_time_never_steps_back_across_the_24_bit_wrap(chunk, disorder_us, measured):
    sent, data = stream_across(WRAP_EVT3_US, disorder_us)
    decoder = Decoder()
    pieces = [decoder.decode(data[at : at + chunk]).t.copy() for at in range(0, len(data), chunk)]
    t = np.concatenate(pieces)
    assert t.size == sent.size
    assert (np.diff(t) >= 0).all()
    # An event that comes late keeps the newest time before it.
    expected = np.maximum.accumulate(sent)
    measured("unwrapped time against the truth, us", np.abs(t - expected).max(), 0)


@pytest.mark.parametrize("wrap_us", [WRAP_INT32_US, WRAP_EVT2_US])
@pytest.mark.hard_case(9)
def test_time_goes_on_beyond_31_and_34_bits(wrap_us, measured):
    rng = np.random.default_rng(SEED)
    t = wrap_us - 50_000 + np.sort(rng.integers(0, 100_000, 3000))
    x, y, p = rng.integers(0, 1280, 3000), rng.integers(0, 720, 3000), np.ones(3000, np.uint8)
    encoder, decoder = Encoder(), Decoder()
    decoder.decode(encoder.advance(0))
    for stop_us in [*range(HOUR_US, int(t[0]), HOUR_US), int(t[0])]:
        decoder.decode(encoder.advance(stop_us))
    events = decoder.decode(encoder.encode(t, x, y, p))
    measured("time across the wrap, us", np.abs(events.t - t).max(), 0)
    track = StageTrack()
    track.append([wrap_us - 60_000, wrap_us + 60_000], [0.0, 36.0])
    expected = (events.t - (wrap_us - 60_000)) * 3e-4
    np.testing.assert_allclose(track.position_mm(events.t), expected, rtol=1e-12)


@pytest.mark.hard_case(9)
def test_profiles_across_the_wrap_are_those_before_it():
    rng = np.random.default_rng(SEED)
    modulation = Modulation(70.0, on_edge_us=1000)
    t, x, y, p = line_events(rng, flat, periods=6, columns=100)
    # Seven periods are exactly 100 000 us.
    shift_us = 167 * 100_000
    assert t[0] + shift_us < WRAP_EVT3_US < t[-1] + shift_us
    near = reconstructed(encoded((t, x, y, p)), modulation)
    far = reconstructed(encoded((t + shift_us, x, y, p)), modulation)
    np.testing.assert_array_equal(far.t_us - shift_us, near.t_us)
    for name in ("column", "row", "sigma_row", "events"):
        np.testing.assert_array_equal(getattr(far, name), getattr(near, name), name)


@pytest.mark.hard_case(10)
def test_shuffled_events_give_the_same_points():
    rng = np.random.default_rng(SEED)
    t, x, y, p = line_events(rng, flat, periods=5, columns=80)
    order = np.argsort(t + rng.uniform(0.0, 50.0, t.size), kind="stable")
    late_us = np.maximum.accumulate(t[order]) - t[order]
    assert 20 < late_us.max() <= 50
    modulation = Modulation(70.0, on_edge_us=1000)
    want = reconstructed(encoded((t, x, y, p)), modulation)
    got = reconstructed(encoded(sort_readout(t[order], x[order], y[order], p[order])), modulation)
    assert_same(got, want)


@pytest.mark.hard_case(10)
def test_unsorted_events_are_refused_where_order_counts():
    t = np.array([100, 150, 120])
    with pytest.raises(ArgumentError, match=r"t\[2\] is 120"):
        Encoder().encode(t, t, t, [1, 1, 1])
    none = np.empty(0, np.int64)
    events = Events(t, *(t.astype(kind) for kind in ("u2", "u2", "u1")), Triggers(none, none, none))
    with pytest.raises(ArgumentError, match=r"t\[2\] is 120"):
        ActivityFilter().filter(events)
    with pytest.raises(ArgumentError, match="t_us goes from 150 to 120"):
        estimate_phase(t, np.ones(3, np.uint8), Modulation(70.0))
    with pytest.raises(ArgumentError, match="t_us goes from 150 to 120"):
        paper_method.reconstruct(t, t, t, MODEL, Modulation(70.0))
    track = StageTrack()
    track.append(t, [0.0, 1.0, 9.0])
    assert (len(track), track.dropped) == (2, 1)
    assert track.position_mm([125]).tolist() == [0.5]


@pytest.mark.parametrize("origin_us", [0, EPOCH_US, -(2**40)])
@pytest.mark.parametrize("speed_mm_s", [50.0, -300.0])
@pytest.mark.hard_case(20)
def test_linear_motion(origin_us, speed_mm_s, measured):
    """Samples every 20 ms lie on whole nanometres, so what is left is interpolation error."""
    t_us = np.arange(0, 2_000_001, 20_000)
    stage = StageTrack()
    stage.append(origin_us + t_us, 300.0 + speed_mm_s * t_us / 1e6)
    query = np.random.default_rng(3).integers(0, 2_000_001, 5000)
    exact = [300 + Fraction(speed_mm_s) * int(t) / 10**6 for t in query]
    position = stage.position_mm(origin_us + query)
    worst = max(abs(Fraction(float(p)) - e) for p, e in zip(position, exact, strict=True))
    measured("interpolated position, share of 300 mm", worst / 300, 1e-12)


@pytest.mark.hard_case(20)
def test_reversal_of_the_motion():
    stage = StageTrack()
    stage.append([0, 10, 20], [0.0, 1.0, 0.0])
    np.testing.assert_allclose(stage.position_mm([5, 10, 15]), [0.5, 1.0, 0.5], rtol=1e-15)


@pytest.mark.hard_case(20)
def test_nothing_is_extrapolated():
    assert np.isnan(StageTrack().position_mm([0, 5])).all()
    single = StageTrack()
    single.append(7, 1.5)
    np.testing.assert_array_equal(single.position_mm([6, 7, 8]), [np.nan, 1.5, np.nan])
    two = StageTrack()
    two.append([7, 9], [1.0, 3.0])
    np.testing.assert_array_equal(two.position_mm([6, 7, 8, 9, 10]), [np.nan, 1, 2, 3, np.nan])


@pytest.mark.hard_case(20)
def test_gaps_are_not_bridged_beyond_the_limit():
    query = [0, 50, 100, 101, 299, 300, 350]
    for limit_us, bridged in ((199, False), (200, True), (None, True)):
        stage = StageTrack(limit_us)
        stage.append([0, 100, 300, 400], [0.0, 1.0, 3.0, 4.0])
        position = stage.position_mm(query)
        inside = [1.01, 2.99] if bridged else [np.nan, np.nan]
        np.testing.assert_allclose(position, [0.0, 0.5, 1.0, *inside, 3.0, 3.5], rtol=1e-15)


@pytest.mark.hard_case(20)
def test_times_at_both_ends_of_int64():
    stage = StageTrack()
    stage.append([-100, 100], [0.0, 1.0])
    assert np.isnan(stage.position_mm([-(2**63), 2**63 - 1])).all()


@pytest.mark.hard_case(21)
def test_point_lies_where_the_stage_was_at_its_events(measured):
    """Mean time of the events used: 1 ms would be 0.3 mm, a batch of 4 ms 1.2 mm."""
    rng = np.random.default_rng(SEED)
    t, x, y, p = line_events(rng, flat, periods=8, columns=64)
    found = reconstructed(encoded((t, x, y, p)), Modulation(70.0, on_edge_us=1000))
    period = np.searchsorted(found.edge_us, t, side="right") > 0
    edges = np.append(np.unique(found.edge_us), 1 << 60)
    place_of = np.searchsorted(edges, t, side="right") - 1
    worst_us = 0.0
    for edge, column, t_us in zip(found.edge_us, found.column, found.t_us, strict=True):
        mine = period & (x == column) & (edges[place_of] == edge)
        worst_us = max(worst_us, abs(float((t[mine] - edge).mean()) - (t_us - edge)))
    measured("time of a point against the mean of its events, us", worst_us, 1.0)
    stage = StageTrack()
    stage.append([0, 1_000_000], [0.0, 300.0])
    points = place(found, MODEL, stage.position_mm(found.t_us), (0.0, 1.0, 0.0))
    error_um = np.abs(points["y"].astype(np.float64) * 1e6 - found.t_us * 0.3).max()
    measured("stage position of a point, um", error_um, 0.3)
