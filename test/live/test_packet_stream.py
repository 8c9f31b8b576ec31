"""Packets with losses, late joins, restarts and clocks of every kind, against one plain run."""

from dataclasses import replace

import numpy as np
import pytest
from line_events import encoded, line_events

from eschorty_ros.core.base.errors import FormatError
from eschorty_ros.core.clocks import PulseTrain
from eschorty_ros.core.evt3 import WRAP_US, Decoder, first_time_high_us
from eschorty_ros.core.evt3 import words as w3
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.core.reconstruction import Profiles, Reconstructor, Settings
from eschorty_ros.live import packet_stream
from eschorty_ros.live.clock_steps import ClockSteps
from eschorty_ros.live.packet_stream import PacketStream
from eschorty_ros.live.packet_times import Packet, check_span, first_time_us
from eschorty_ros.live.pipeline import Pipeline

ZERO_NS = 1_700_000_000_123_456_789
EDGE_US = 1000
CALIBRATION = load_calibration("config_3")
MODULATION = Modulation(70.0)


def line(seed=3, offset_us=0, triggers_us=None, periods=8):
    """Bytes of a flat line at row 300, times shifted by ``offset_us``."""
    rng = np.random.default_rng(seed)
    t, x, y, p = line_events(
        rng, lambda k, c: np.full(len(c), 300.0), periods=periods, edge_us=EDGE_US
    )
    return encoded((t + offset_us, x, y, p), triggers_us)


def packets(data, size=60_000, seq=0, stamp_ns=ZERO_NS):
    """The bytes in packets stamped 1 ms apart."""
    return [
        Packet(seq + i, stamp_ns + i * 1_000_000, data[begin : begin + size])
        for i, begin in enumerate(range(0, len(data), size))
    ]


def stream(settings=None):
    return PacketStream(CALIBRATION, settings or Settings(), clock_timeout_s=1.0)


def push(made, items):
    for item in items:
        made.add(item, 0.0)
    return made.process(0.0)


def joined(parts):
    return Profiles.concatenate([part.profiles for part in parts])


def times_ns(parts):
    return np.concatenate([part.t_ns for part in parts])


def plain(data, on_edge_us=EDGE_US):
    reconstructor = Reconstructor(CALIBRATION, Modulation(70.0, on_edge_us=on_edge_us), Settings())
    return Profiles.concatenate([reconstructor.push(data), reconstructor.flush()])


AT_ONCE = pytest.mark.parametrize("at_once", [False, True])


def run(subject, items, now_s=0.0, at_once=False):
    """Profiles of packets that are processed one by one, or all after they have waited."""
    out = []
    for packet in items:
        subject.add(packet, now_s)
        out += [] if at_once else subject.process(now_s)
    return out + subject.process(now_s) + subject.flush()


def announced():
    subject = stream()
    subject.announce_zero(ZERO_NS)
    subject.set_laser(MODULATION, ZERO_NS + EDGE_US * 1000)
    return subject


def test_exact_clock_gives_the_plain_result_in_ros_time():
    data = line()
    expected = plain(data)
    parts = run(announced(), packets(data))
    for name in ("edge_us", "t_us", "column", "row", "events"):
        np.testing.assert_array_equal(getattr(joined(parts), name), getattr(expected, name))
    np.testing.assert_array_equal(times_ns(parts), expected.t_us * 1000 + ZERO_NS)


def test_packets_are_held_until_clock_and_modulation_are_known():
    data = line()
    subject = stream()
    for packet in packets(data):
        subject.add(packet, 0.0)
    assert subject.process(0.5) == []
    assert subject.waits_for == "modulation"
    subject.set_laser(MODULATION, ZERO_NS + EDGE_US * 1000)
    assert subject.process(0.5) == []
    assert subject.waits_for == "camera clock"
    subject.announce_zero(ZERO_NS)
    seen = joined(subject.process(0.5) + subject.flush())
    np.testing.assert_array_equal(seen.row, plain(data).row)
    assert subject.packets_lost == 0


def test_events_that_the_sensor_lost_are_a_warning():
    data = line()
    subject = announced()
    run(subject, packets(data))
    assert subject.warnings == []
    dropped = np.array([w3.OTHERS << 12 | w3.DROPPED_EVENTS], "<u2").tobytes()
    subject = announced()
    run(subject, packets(data + dropped))
    assert len(subject.warnings) == 1
    assert "reports 1 times that its readout lost events" in subject.warnings[0]


def test_held_packets_are_bounded_and_the_rest_counts_as_lost(monkeypatch):
    monkeypatch.setattr(packet_stream, "_HELD_MAX", 2)
    subject = PacketStream(CALIBRATION, Settings(), clock_timeout_s=1.0)
    items = packets(line(), size=20_000)
    for packet in items[:6]:
        subject.add(packet, 0.0)
    subject.announce_zero(ZERO_NS)
    subject.set_laser(MODULATION, None)
    subject.process(0.0)
    run(subject, items[6:])
    assert subject.packets_lost == 4
    assert subject.packets == len(items) - 4


def test_without_an_announcement_the_stamps_serve_and_the_phase_comes_from_the_events():
    subject = stream()
    subject.set_laser(MODULATION, ZERO_NS + 777_000)
    items = [Packet(p.seq, ZERO_NS + 5_000_000, p.data) for p in packets(line())]
    subject.add(items[0], 0.0)
    assert subject.process(0.5) == []
    parts = run(subject, items[1:], now_s=1.1)
    assert not subject.epoch.clock.exact
    edges = np.unique(joined(parts).edge_us)
    period_us = MODULATION.period_us
    off_us = (edges - EDGE_US + period_us / 2) % period_us - period_us / 2
    # The estimate includes the pixels' latency.
    assert np.abs(off_us).max() < 0.1 * period_us


@AT_ONCE
def test_gap_in_seq_is_counted_and_later_periods_are_the_plain_ones(at_once):
    data = line(periods=16)
    expected = plain(data)
    items = packets(data, size=20_000)
    subject = announced()
    seen = joined(run(subject, [*items[:2], *items[3:]], at_once=at_once))
    assert subject.packets_lost == 1
    late = seen.edge_us >= EDGE_US + 8 * MODULATION.period_us
    late_expected = expected.edge_us >= EDGE_US + 8 * MODULATION.period_us
    assert late.any()
    np.testing.assert_array_equal(seen.edge_us[late], expected.edge_us[late_expected])
    # Not bit for bit: windows are seeded, and half widths chosen, by the profiles before.
    assert np.mean(seen.row[late] == expected.row[late_expected]) > 0.99


@pytest.mark.parametrize("wraps", [1, 5])
def test_a_stream_joined_late_is_brought_to_the_announced_zero(wraps):
    shift_us = wraps * WRAP_US
    stamp_ns = ZERO_NS + shift_us * 1000 + 40_000_000
    parts = run(announced(), packets(line(), seq=1000, stamp_ns=stamp_ns))
    edges_ns = np.unique(np.concatenate([part.edge_ns for part in parts]))
    index = np.rint((edges_ns - ZERO_NS) * 1e-9 * 70.0 - EDGE_US * 7e-5)
    on_grid = ZERO_NS + EDGE_US * 1000 + np.rint(index * 1e9 / 70.0)
    assert np.abs(edges_ns - on_grid).max() <= 1000
    assert ZERO_NS + shift_us * 1000 <= times_ns(parts).min()


def test_a_stream_joined_at_a_packet_without_a_time_high_keeps_the_announced_zero():
    stamp_ns = ZERO_NS + 3 * WRAP_US * 1000 + 40_000_000
    items = packets(line(), size=2000, seq=1000, stamp_ns=stamp_ns)
    first = next(i for i, item in enumerate(items) if first_time_high_us(item.data) is None)
    subject = announced()
    subject.add(items[first], 0.0)
    assert subject.process(0.0) == []
    assert subject.waits_for == "sensor's time"
    parts = run(subject, items[first + 1 :])
    assert subject.announcements_refused == subject.packets_lost == 0
    assert ZERO_NS + 3 * WRAP_US * 1000 <= times_ns(parts).min() < stamp_ns
    assert subject.counters["decoder_events_before_time"] > 0


def test_more_periods_than_a_frequency_allows_are_limited_with_a_warning():
    subject = stream(Settings(periods_per_profile=1000))
    subject.announce_zero(ZERO_NS)
    subject.set_laser(Modulation(5000.0), None)
    items = packets(line())
    run(subject, items[:2])
    assert not any("allows" in line for line in subject.warnings)
    subject.set_laser(MODULATION, None)
    run(subject, items[2:])
    assert subject.packets_lost == 0
    assert subject.packets == len(items)
    assert subject.warnings[0] == "periods_per_profile is 1000; 70 Hz allows 145"


def test_a_zero_announced_again_is_not_forgotten_at_the_next_scan():
    subject = announced()
    subject.drop_zero()
    subject.announce_zero(ZERO_NS)
    subject.begin_scan()
    assert subject.epoch is not None


def test_times_after_a_camera_restart_are_of_its_new_clock():
    data = line()
    subject = announced()
    first = run(subject, packets(data))
    later_ns = ZERO_NS + 30_000_000_000
    for packet in packets(data, stamp_ns=later_ns):
        subject.add(packet, 0.0)
    # Seq went back and no new zero was announced: nothing is placed by the old clock.
    assert subject.process(0.1) == []
    subject.set_laser(MODULATION, later_ns + EDGE_US * 1000)
    subject.announce_zero(later_ns)
    second = subject.process(0.2) + subject.flush()
    assert subject.restarts == 1
    assert subject.packets_lost == 0
    np.testing.assert_array_equal(joined(second).row, joined(first).row)
    assert np.unique(times_ns(second) - times_ns(first)).tolist() == [30_000_000_000]
    assert subject.counters["points"] == len(joined(first)) + len(joined(second))


def test_new_settings_apply_from_the_next_packet_on_and_keep_the_time():
    data = line()
    items = packets(data)
    subject = announced()
    half = len(items) // 2
    before = []
    for packet in items[:half]:
        subject.add(packet, 0.0)
        before += subject.process(0.0)
    subject.set_settings(Settings(smoothing_half_width=0))
    after = run(subject, items[half:])
    edges = np.unique(joined(before + after).edge_us)
    np.testing.assert_array_equal(edges, np.unique(plain(data).edge_us))


def unannounced(**settings):
    subject = stream(Settings(**settings))
    subject.announcement_expected = False
    subject.set_laser(MODULATION, None)
    return subject


def sent(data, shift_us=0, seq=0):
    """Packets stamped when their last event had happened."""
    decoder = Decoder()
    out = []
    for packet in packets(data, size=6000, seq=seq):
        decoder.decode(packet.data)
        stamp_ns = ZERO_NS + (decoder.time_us + shift_us) * 1000
        out.append(Packet(packet.seq, stamp_ns, packet.data))
    return out


def test_without_a_publisher_no_announcement_is_waited_for():
    subject = unannounced()
    subject.add(packets(line())[0], 0.0)
    subject.process(0.0)
    assert (subject.held, subject.packets, subject.epoch.clock.exact) == (0, 1, False)


@pytest.mark.parametrize("gap_us", [1_000_000, 12_000_000, 40_000_000])
def test_time_goes_on_over_a_gap_of_any_length(gap_us):
    """More than half a wrap of the stream's time without packets: the stamps count the wraps."""
    subject = unannounced()
    first = run(subject, sent(line()))
    later = sent(line(offset_us=gap_us % WRAP_US), gap_us - gap_us % WRAP_US, seq=1000)
    second = run(subject, later)
    assert subject.packets_lost > 800
    assert subject.clock_restarts == 0
    for parts, shift_us in ((first, 0), (second, gap_us)):
        part = parts[len(parts) // 2].retimed()
        expected_ns = ZERO_NS + part.sensor.t_us * 1000
        assert np.abs(part.t_ns - expected_ns).max() < 5_000_000
        assert part.t_ns.min() > ZERO_NS + shift_us * 1000 - 5_000_000


@AT_ONCE
@pytest.mark.parametrize("gap_us", [12_000_000, 40_000_000])
def test_a_gap_without_numbers_is_told_from_a_host_that_stood_still(gap_us, at_once):
    """A driver numbers only what it sends, and sends nothing while it sees no subscriber."""
    first = sent(line())
    later = sent(line(offset_us=gap_us % WRAP_US), gap_us - gap_us % WRAP_US, seq=len(first))
    subject = unannounced()
    run(subject, first)
    parts = run(subject, later, at_once=at_once)
    for part in (parts[0], parts[-1]):
        part = part.retimed()
        true_ns = ZERO_NS + (part.sensor.t_us % WRAP_US + gap_us - gap_us % WRAP_US) * 1000
        assert np.abs(part.t_ns - true_ns).max() < 5_000_000
    assert subject.clock_restarts == 0

    stalled = unannounced()
    half = len(first) // 2
    run(stalled, first[:half])
    last_ns = first[-1].stamp_ns + 1000 * gap_us
    parts = run(stalled, [Packet(p.seq, last_ns, p.data) for p in first[half:]], at_once=at_once)
    part = parts[-1].retimed()
    assert np.abs(part.t_ns - ZERO_NS - part.sensor.t_us * 1000).max() < 5_000_000


@AT_ONCE
def test_packets_twice_or_in_the_wrong_order_are_no_restart_of_the_camera(at_once):
    items = packets(line(), size=20_000)
    expected = joined(run(announced(), items))
    subject = announced()
    seen = joined(run(subject, [*items[:4], items[3], *items[4:]], at_once=at_once))
    assert (subject.restarts, subject.packets_lost, subject.packets_late) == (0, 0, 1)
    np.testing.assert_array_equal(seen.row, expected.row)

    subject = announced()
    run(subject, [*items[:4], items[5], items[4], *items[6:]], at_once=at_once)
    assert (subject.restarts, subject.packets_lost, subject.packets_late) == (0, 1, 1)
    assert subject.epoch.clock.exact


def test_a_time_low_that_the_sensor_takes_back_does_not_move_the_clock():
    """At the end of each packet; its correction begins the next."""
    words = np.frombuffer(line(), "<u2")
    decoder = Decoder()
    plain, spoilt = [], []
    for seq, piece in enumerate(np.split(words, np.flatnonzero(words >> 12 == 6)[50::50])):
        decoder.decode(piece.tobytes())
        stamp_ns = ZERO_NS + decoder.time_us * 1000
        plain.append(Packet(seq, stamp_ns, piece.tobytes()))
        spoilt.append(Packet(seq, stamp_ns, np.append(piece, np.uint16(0x6FFF)).tobytes()))
    assert len(plain) > 50
    zeros = []
    for items in (plain, spoilt):
        subject = unannounced()
        run(subject, items)
        assert subject.clock_restarts == 0
        zeros.append(subject.epoch.clock.zero_ns)
    assert abs(zeros[1] - zeros[0]) < 20_000


def test_points_move_with_the_clock_until_they_are_placed():
    subject = unannounced()
    late = [Packet(p.seq, p.stamp_ns + 3_000_000_000, p.data) for p in sent(line())]
    parts = run(subject, late)
    before_ns = parts[0].t_ns.copy()
    prompt = sent(line(offset_us=3_000_000), seq=len(late))
    run(subject, [Packet(p.seq, max(p.stamp_ns, late[-1].stamp_ns), p.data) for p in prompt])
    moved_ns = parts[0].retimed().t_ns - before_ns
    assert np.ptp(moved_ns) <= 1000
    assert -3_050_000_000 < moved_ns[0] < -2_800_000_000


def test_points_after_a_clock_set_forward_are_in_its_time_and_a_scan_meanwhile_fails():
    pipeline = Pipeline(CALIBRATION, Settings(), 0.0, 1.0, 10.0)
    pipeline.stream.announcement_expected = False
    pipeline.stream.set_laser(MODULATION, None)
    steps, step_ns = ClockSteps(), 100_000_000

    def scan(scan_id, begin_us, set_ns, lead_ns):
        """Return the report of 8 periods by a clock that leads and is set before the end."""
        pipeline.begin_scan(scan_id, 0.0, 1.0)
        for packet in sent(line(offset_us=begin_us), seq=begin_us):
            pipeline.add_packet(replace(packet, stamp_ns=packet.stamp_ns + lead_ns), 0.0)
            pipeline.process(0.0)
        for now_s in (0.0, 0.1, 1.0):
            seen_ns = steps.step_ns(lead_ns + set_ns * (now_s > 0.0), begin_us * 1e-6 + now_s)
            if seen_ns:
                pipeline.follow_clock(seen_ns)
        for after_us in range(0, 300_000, 10_000):
            pipeline.add_stage(ZERO_NS + (begin_us + after_us) * 1000 + lead_ns, 0.5)
        pipeline.close_period(scan_id, 0.0)
        pipeline.place(0.0)
        return pipeline.end_scan()

    first = scan("first", 0, step_ns, 0)
    assert pipeline.stream.clock_restarts == 2
    assert first.completeness == 0.0
    assert "the computer's clock was set by +0.100 s, which shifts points" in first.message
    second = scan("second", 2_000_000, 0, step_ns)
    assert "clock" not in second.message
    assert len(second.scan.points) > 5000
    late_ns = second.scan.stamp_ns - (ZERO_NS + 2_000_000_000 + step_ns)
    assert abs(late_ns) < 5_000_000


def test_an_announced_clock_stays_when_the_computers_is_set():
    pipeline = Pipeline(CALIBRATION, Settings(), 0.0, 1.0, 10.0)
    pipeline.stream.announce_zero(ZERO_NS)
    pipeline.stream.set_laser(MODULATION, None)
    pipeline.begin_scan("replayed", 0.0, 1.0)
    for packet in sent(line()):
        pipeline.add_packet(packet, 0.0)
    pipeline.process(0.0)
    assert not pipeline.follow_clock(100_000_000)
    pipeline.close_period("replayed", 0.0)
    report = pipeline.end_scan()
    assert pipeline.stream.clock_restarts == 0
    assert "clock was set" not in report.message


def test_a_clock_set_back_starts_an_epoch_and_leaves_old_points_alone():
    subject = unannounced()
    items = sent(line())
    half = len(items) // 2
    parts = run(subject, items[:half])
    before_ns = parts[0].t_ns
    for packet in items[half:]:
        subject.add(Packet(packet.seq, packet.stamp_ns - 10**12, packet.data), 0.0)
    parts_after = subject.process(0.0) + subject.flush()
    assert subject.clock_restarts == 1
    np.testing.assert_allclose(parts[0].retimed().t_ns, before_ns, atol=5_000_000)
    assert parts_after[-1].t_ns.max() < ZERO_NS - 9 * 10**11


@pytest.mark.parametrize("source", ["laser", "stage", "none"])
def test_edges_at_the_trigger_input_go_where_they_are_wired_to(source):
    """Edges every 7 ms are no laser of 70 Hz."""
    edges = np.arange(2000, 110_000, 7000)
    subject = unannounced(trigger_source=source)
    subject.set_pulses(PulseTrain(0.0, 2.0, 100))
    run(subject, packets(line(triggers_us=edges)))
    triggered = subject.counters["triggers_used"] + subject.counters["triggers_spurious"]
    assert (triggered > 0) == (source == "laser")
    assert len(subject.epoch.edges) == (edges.size if source == "stage" else 0)


def test_the_phase_is_found_again_when_the_laser_is_switched_on():
    period_us = 1e6 / 70
    later_us = round(40.37 * period_us)
    subject = unannounced()
    subject.set_laser(MODULATION, None, 1)
    run(subject, sent(line()))
    subject.set_laser(MODULATION, None, None)
    subject.set_laser(MODULATION, None, 2)
    second = run(subject, sent(line(seed=4, offset_us=later_us), seq=100))
    off = (np.unique(joined(second).edge_us) - EDGE_US - later_us) / period_us
    assert np.abs(off - np.rint(off)).max() < 0.02


@pytest.mark.parametrize(
    ("words", "before_us", "after_us", "found"),
    [
        ([0x8003, 0x6010], None, 0x3010, 0x3010),
        ([0x0001, 0x6010, 0x8004, 0x6001], 0x3001, 0x4001, 0x3010),
        ([0x0001, 0x8004], 0x3001, 0x4000, 0x4000),
        ([0x0001, 0x2001], 0x3001, 0x3001, None),
        # Across the wrap, and a broken word that the decoder left out.
        ([0x8000, 0x6010], WRAP_US - 5, WRAP_US + 0x10, WRAP_US + 0x10),
        ([0x8800, 0x6010], 0x3001, 0x3020, 0x3001),
    ],
)
def test_time_of_a_packets_first_bytes(words, before_us, after_us, found):
    data = np.array(words, "<u2").tobytes()
    assert first_time_us(data, before_us, after_us) == (before_us if found is None else found)


def test_an_announced_zero_that_contradicts_the_stamps_is_refused_and_counted():
    data = line()
    subject = stream()
    subject.announce_zero(ZERO_NS + 3_600_000_000_000)
    subject.set_laser(MODULATION, None)
    parts = run(subject, packets(data))
    assert subject.announcements_refused == 1
    assert not subject.epoch.clock.exact
    t_ns = np.concatenate([part.t_ns for part in parts])
    assert np.abs(t_ns - ZERO_NS).max() < 1_000_000_000


def test_packets_of_another_source_leave_no_trace_in_the_clock():
    data = line()
    subject = stream()
    subject.announcement_expected = False
    subject.set_laser(MODULATION, None)
    future_ns = ZERO_NS + 86_400_000_000_000
    items = packets(line(4, 9_000_000), seq=2**64 - 9, stamp_ns=future_ns)
    hostile = [Packet(p.seq, p.stamp_ns, p.data, b"other") for p in items[:3]]
    run(subject, hostile)
    lost = subject.packets_lost
    parts = run(subject, packets(data))
    t_ns = np.concatenate([part.t_ns for part in parts])
    assert np.abs(t_ns - ZERO_NS).max() < 1_000_000_000
    assert subject.packets_lost == lost == 0
    np.testing.assert_array_equal(np.unique(joined(parts).column), np.unique(plain(data).column))


def test_a_packet_whose_time_runs_on_is_refused():
    wrapping = np.tile([0x8000, 0x8000, 0x87FF, 0x87FF], 5_000).astype("<u2").tobytes()
    for data in (wrapping, np.random.default_rng(5).bytes(100_000)):
        with pytest.raises(FormatError, match="spans"):
            check_span(data)
    check_span(line())


def ended(pipeline):
    """Return the report of a scan under way, with the stage at 0.5 mm all the time."""
    for at_ns in (ZERO_NS, ZERO_NS + 1_000_000_000):
        pipeline.add_stage(at_ns, 0.5)
    pipeline.close_period("s", 0.0)
    pipeline.place(0.0)
    return pipeline.end_scan()


def test_profiles_that_wait_for_the_stage_as_a_scan_begins_are_not_of_it():
    data = line()
    pipeline = Pipeline(CALIBRATION, Settings(periods_per_profile=1), 1.0, 0.0, 6.0)
    pipeline.stream.announce_zero(ZERO_NS)
    pipeline.stream.set_laser(MODULATION, ZERO_NS + EDGE_US * 1000)
    parts = packets(data, size=len(data) // 16 * 2)
    for packet in parts[:4]:
        pipeline.add_packet(packet, 0.0)
    pipeline.process(0.0)
    waiting = pipeline.placer.waiting
    assert waiting > 0
    pipeline.begin_scan("s", 0.0, 1.0)
    for packet in parts[4:]:
        pipeline.add_packet(packet, 0.0)
    pipeline.process(0.0)
    report = ended(pipeline)
    assert report.points_outside >= waiting
    assert 0 < len(report.scan.points) == len(plain(data)) - report.points_outside


def scanned(pipeline, scan_id, begin_us, odometry_us, stamp_ns=None):
    """Return the report of a scan of 114 ms whose odometry lasts for a time; all times shifted."""
    now_s, begin_ns = begin_us * 1e-3, ZERO_NS + begin_us * 1000
    pipeline.begin_scan(scan_id, 0.0, 1.0)
    for packet in packets(line(offset_us=begin_us), seq=begin_us):
        pipeline.add_packet(packet, now_s)
    pipeline.process(now_s)
    for after_us in range(0, odometry_us + 1, 10_000):
        at_ns = begin_ns + after_us * 1000 if stamp_ns is None else stamp_ns
        pipeline.add_stage(at_ns, 0.5)
    pipeline.close_period(scan_id, now_s + 1.0)
    pipeline.place(now_s + 1.0)
    pipeline.place(now_s + 5.0)
    assert not pipeline.placer.holds(now_s + 1.0)
    return pipeline.end_scan()


@pytest.mark.parametrize("stamp_ns", [None, 0])
def test_points_that_wait_for_the_stage_at_the_end_are_losses_of_their_scan_alone(stamp_ns):
    pipeline = Pipeline(CALIBRATION, Settings(periods_per_profile=1), 1.0, 0.0, 10.0)
    pipeline.stream.announce_zero(ZERO_NS)
    pipeline.stream.set_laser(MODULATION, ZERO_NS + EDGE_US * 1000)
    cut = scanned(pipeline, "cut", 0, 50_000, stamp_ns)
    assert cut.points_without_stage > 1000, "seed 3"
    assert cut.points_without_stage + len(cut.scan.points) == len(plain(line()))
    assert "points had no stage position; check that stage/odom goes on" in cut.message
    assert cut.completeness < 0.9
    assert pipeline.placer.points_without_stage == cut.points_without_stage
    whole = scanned(pipeline, "whole", 200_000, 200_000)
    assert len(whole.scan.points) > 5000
    assert (whole.points_without_stage, pipeline.placer.waiting) == (0, 0)


def test_points_of_before_a_scan_that_the_stage_never_covers_are_no_losses_of_it():
    pipeline = Pipeline(CALIBRATION, Settings(periods_per_profile=1), 1.0, 0.0, 10.0)
    pipeline.stream.announce_zero(ZERO_NS)
    pipeline.stream.set_laser(MODULATION, ZERO_NS + EDGE_US * 1000)
    for packet in packets(line()):
        pipeline.add_packet(packet, 95.0)
    pipeline.process(95.0)
    waiting = pipeline.placer.waiting
    assert waiting > 5000, "seed 3"
    pipeline.begin_scan("s", 0.0, 1.0)
    for packet in packets(line(offset_us=200_000), seq=1000):
        pipeline.add_packet(packet, 101.0)
    pipeline.process(101.0)
    # The stage's first sample is after the first run: that has no position.
    for at_ns in (200_000_000, 400_000_000):
        pipeline.add_stage(ZERO_NS + at_ns, 0.5)
    pipeline.close_period("s", 102.0)
    pipeline.place(106.0)
    report = pipeline.end_scan()
    assert pipeline.placer.points_without_stage >= waiting
    assert len(report.scan.points) > 5000
    assert report.points_without_stage == 0


@pytest.mark.parametrize("some_pass", [False, True])
def test_the_report_of_a_scan_has_the_reason_of_refused_packets(some_pass):
    pipeline = Pipeline(CALIBRATION, Settings(), 1.0, 0.0, 6.0)
    pipeline.stream.announce_zero(ZERO_NS)
    pipeline.stream.set_laser(MODULATION, ZERO_NS + EDGE_US * 1000)
    pipeline.note_refused("of before the scan")
    pipeline.begin_scan("s", 0.0, 1.0)
    for packet in packets(line()) if some_pass else ():
        pipeline.add_packet(packet, 0.0)
    pipeline.process(0.0)
    pipeline.note_refused("encoding is evt2; set the camera to evt3")
    with pytest.raises(FormatError):
        pipeline.add_packet(Packet(99, ZERO_NS, np.random.default_rng(5).bytes(100_000)), 0.0)
    report = ended(pipeline)
    assert "2 packets were refused, the last: a packet of 100000 bytes spans" in report.message, (
        "seeds 3, 5"
    )
    assert "no events came" not in report.message
    assert bool(len(report.scan.points)) == some_pass


@pytest.mark.parametrize("streams", [1, 3])
def test_a_scan_with_more_profiles_than_its_time_allows_is_not_complete(streams):
    """A wrong clock puts events of several times at one time."""
    pipeline = Pipeline(CALIBRATION, Settings(periods_per_profile=1), 1.0, 0.0, 6.0)
    pipeline.begin_scan("s", 0.0, 1.0)
    for k in range(streams):
        zero_ns = ZERO_NS + k * 4_000_000
        pipeline.stream.announce_zero(zero_ns)
        pipeline.stream.set_laser(MODULATION, zero_ns + EDGE_US * 1000)
        for packet in packets(line()):
            pipeline.add_packet(packet, 0.0)
        pipeline.process(0.0)
    for k in range(-2, 15):
        pipeline.add_stage(ZERO_NS + k * 10_000_000, 0.01 + k / 12.0)
    pipeline.close_period("s", 0.0)
    pipeline.place(0.0)
    report = pipeline.end_scan()
    print(f"seed 3: {report.scan.profiles} of {report.profiles_expected}")
    assert (report.completeness < 0.9) == (streams > 1)
    assert ("more than there can be" in report.message) == (streams > 1)


def test_a_modulation_that_is_set_after_the_light_has_ended_changes_no_count_of_a_scan():
    reports = []
    for after in (MODULATION, Modulation(140.0)):
        pipeline = Pipeline(CALIBRATION, Settings(periods_per_profile=1), 1.0, 0.0, 6.0)
        epoch_ns = ZERO_NS + EDGE_US * 1000
        pipeline.stream.announce_zero(ZERO_NS)
        pipeline.begin_scan("s", 0.0, 1.0)
        pipeline.stream.set_laser(MODULATION, epoch_ns, on_since_ns=ZERO_NS)
        for packet in packets(line()):
            pipeline.add_packet(packet, 0.0)
        pipeline.process(0.0)
        pipeline.stream.set_laser(MODULATION, epoch_ns)
        pipeline.stream.set_laser(after, None)
        for k in range(-2, 15):
            pipeline.add_stage(ZERO_NS + k * 10_000_000, 0.01 + k / 12.0)
        pipeline.close_period("s", 0.0)
        pipeline.place(0.0)
        reports.append(pipeline.end_scan())
    before, changed = reports
    assert changed.profiles_expected == before.profiles_expected > 0, "seed 3"
    assert (changed.completeness, changed.message) == (before.completeness, before.message)


def test_the_report_of_a_scan_has_the_warnings_of_its_stream():
    pipeline = Pipeline(CALIBRATION, Settings(line_width_px=6.0), 1.0, 0.0, 6.0)
    pipeline.stream.announce_zero(ZERO_NS)
    pipeline.stream.set_laser(MODULATION, ZERO_NS + EDGE_US * 1000)
    pipeline.begin_scan("s", 0.0, 1.0)
    for packet in packets(line()):
        pipeline.add_packet(packet, 0.0)
    pipeline.process(0.0)
    assert "as wide as line_width_px = 6" in ended(pipeline).message


def test_profiles_that_wait_for_the_stage_keep_their_calibration():
    data, turned = line(), replace(CALIBRATION, stage_direction=(0.0, -1.0, 0.0))
    placed = {}
    for exchanged in (False, True):
        pipeline = Pipeline(CALIBRATION, Settings(periods_per_profile=1), 1.0, 0.0, 6.0)
        pipeline.stream.announce_zero(ZERO_NS)
        pipeline.stream.set_laser(MODULATION, ZERO_NS + EDGE_US * 1000)
        for packet in packets(data):
            pipeline.add_packet(packet, 0.0)
        pipeline.process(0.0)
        if exchanged:
            pipeline.set_calibration(turned)
        for at_ns in (ZERO_NS, ZERO_NS + 1_000_000_000):
            pipeline.add_stage(at_ns, 0.5)
        placed[exchanged] = np.concatenate([part.points for part in pipeline.place(0.0)])
    before = placed[False]
    assert len(before) > 5000
    # The exchange closes the open period, too.
    np.testing.assert_array_equal(placed[True][: len(before)], before)
    assert np.all(placed[True]["y"] > 0.0)


def test_warnings_are_about_the_light_that_is_on_or_was_last():
    """Periods without light have few events; where the frequency is given, no light is reported."""
    rng, dark_us = np.random.default_rng(5), (200_000, 1_500_000)
    n = 300_000
    dark = encoded(
        (
            np.sort(rng.integers(*dark_us, n)),
            rng.integers(0, 1280, n),
            rng.integers(0, 720, n),
            rng.integers(0, 2, n),
        )
    )
    lit = packets(line())
    later = packets(dark, seq=len(lit), stamp_ns=ZERO_NS + 200_000_000)
    made = stream(Settings(periods_per_profile=1))
    made.announce_zero(ZERO_NS)
    epoch_ns = ZERO_NS + EDGE_US * 1000
    made.set_laser(MODULATION, epoch_ns, on_since_ns=ZERO_NS)
    push(made, lit)
    made.set_laser(MODULATION, epoch_ns, None)
    push(made, later)
    made.flush()
    assert made.warnings == [], "seeds 3 and 5"
    made.begin_scan()
    assert made.warnings == []
    without = stream(Settings(periods_per_profile=1))
    without.announce_zero(ZERO_NS)
    without.set_laser(MODULATION, epoch_ns)
    push(without, lit + later)
    without.flush()
    assert any("have too few events for a point" in text for text in without.warnings)


def test_a_frequency_other_than_the_lasers_has_a_warning():
    made = stream()
    made.announce_zero(ZERO_NS)
    made.set_override(Modulation(140.0))
    push(made, packets(line()))
    made.set_laser(Modulation(140.0), None)
    assert not [text for text in made.warnings if "the laser reports" in text]
    made.set_laser(Modulation(70.0), None)
    assert "frequency is 140 Hz and the laser reports 70 Hz" in made.warnings[0]


def test_without_an_override_the_laser_counts_again_and_the_change_has_a_warning():
    parts = packets(line())
    made, plain = (stream() for _ in range(2))
    found = []
    for subject in (made, plain):
        subject.announce_zero(ZERO_NS)
        subject.set_laser(MODULATION, ZERO_NS + EDGE_US * 1000, on_since_ns=ZERO_NS)
    made.set_override(Modulation(140.0))
    assert made.frequency_hz == 140.0
    made.set_override(None)
    assert made.frequency_hz == MODULATION.frequency_hz
    found = [joined(run(subject, parts)).row for subject in (made, plain)]
    assert np.array_equal(*found)
    assert "the laser's modulation was changed while it was on" in made.warnings
    made.set_override(Modulation(140.0))
    made.set_laser(MODULATION, None, None)
    made.set_laser(MODULATION, None, ZERO_NS + 1)
    assert made.frequency_hz == 140.0
    alone = stream()
    alone.set_override(MODULATION)
    alone.set_override(None)
    assert alone.waits_for == "modulation"


@pytest.mark.parametrize("since_ns", [ZERO_NS, ZERO_NS + 1])
def test_a_modulation_that_is_changed_while_it_is_on_has_a_warning(since_ns):
    """A generator of counted bursts begins a new phase with the change."""
    made = stream()
    made.announce_zero(ZERO_NS)
    epoch_ns = ZERO_NS + EDGE_US * 1000
    made.set_laser(Modulation(90.0), epoch_ns)
    made.set_laser(MODULATION, epoch_ns, on_since_ns=ZERO_NS)
    push(made, packets(line()))
    assert not [text for text in made.warnings if "changed" in text]
    made.set_laser(Modulation(90.0), epoch_ns, on_since_ns=since_ns)
    assert "the laser's modulation was changed while it was on" in made.warnings
    made.set_laser(MODULATION, epoch_ns, None)
    made.set_laser(MODULATION, epoch_ns, on_since_ns=ZERO_NS + 2)
    assert not [text for text in made.warnings if "changed" in text]


def test_packets_without_numbers_have_a_warning():
    """Some end before the clock knows a time."""
    subject = unannounced()
    run(subject, [replace(packet, seq=0) for packet in packets(line(), size=20_000)])
    assert "seq has to be one more with each packet" in subject.warnings[0]
    assert subject.counters["points_without_time"] > 0
