"""A moving line through packets, odometry and edges: how far a point lies from where it was."""

import numpy as np
import pytest
from line_events import line_events
from stage_pulses import EPOCH_NS, PULSES, StagePulses

from eschorty_ros.core.evt3 import Encoder
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.core.reconstruction import Profiles, Reconstructor, Settings
from eschorty_ros.live.packet_stream import clock_statistics
from eschorty_ros.live.packet_times import Packet
from eschorty_ros.live.pipeline import Pipeline

SEED = 21
CALIBRATION = load_calibration("config_3")
FREQUENCY_HZ = 300.0
PERIOD_US = 4000
SPEED = 300.0


class Run:
    """One sweep at 300 mm/s over a flat sheet, 12 columns, the laser on just before it."""

    def __init__(self, drift, delay_ns, *, missing=0.02, spurious=0, odometry_mm=0.0, seed=SEED):
        self.bench = bench = StagePulses(
            (10.0, 110.0), SPEED, drift=drift, missing=missing, spurious=spurious,
            odometry_mm=odometry_mm, seed=seed, lead_s=4.0,
        )  # fmt: skip
        rng = np.random.default_rng(seed)
        self.begin_us = int(bench.true.to_us(bench.plans[0].start_ns)) - 100_000
        self.end_us = int(bench.true.to_us(bench.until_ns)) - 300_000
        t, x, y, p = line_events(
            rng, lambda k, c: np.full(c.shape, 300.0), frequency_hz=FREQUENCY_HZ, columns=12,
            periods=round((self.end_us - self.begin_us) * FREQUENCY_HZ / 1e6),
            edge_us=self.begin_us,
        )  # fmt: skip
        edges = np.sort(np.concatenate([bench.edges, bench.falls]))
        kinds = np.isin(edges, bench.edges).astype(np.uint8)
        encoder = Encoder()
        self.packets = []
        last_ns = 0
        for seq, begin in enumerate(range(0, int(bench.true.to_us(bench.until_ns)), PERIOD_US)):
            end = begin + PERIOD_US
            mine = slice(*np.searchsorted(t, (begin, end)))
            hits = slice(*np.searchsorted(edges, (begin, end)))
            data = encoder.advance(begin) + encoder.encode(
                t[mine], x[mine], y[mine], p[mine],
                trigger_t=edges[hits], trigger_edge=kinds[hits],
            )  # fmt: skip
            sent_ns = bench.true.to_ns(end)
            delay = int(delay_ns((sent_ns - EPOCH_NS) * 1e-9, rng))
            last_ns = max(last_ns, sent_ns + delay)
            self.packets.append(Packet(seq, last_ns, data))

    def scan(self, trigger_source, pulses=PULSES):
        settings = Settings(trigger_source=trigger_source)
        pipeline = Pipeline(CALIBRATION, settings, 2.0, 0.5, 6.0, PERIOD_US * 1e-6)
        pipeline.stream.announcement_expected = False
        pipeline.stream.set_pulses(pulses)
        pipeline.stream.set_laser(Modulation(FREQUENCY_HZ), None, None)
        pipeline.begin_scan("sweep", 0.0, 220.0)
        held, bench = self.packets[:], self.bench
        live = 0
        until_ns = max(self.packets[-1].stamp_ns, bench.until_ns) + 500_000_000
        for now_ns in range(EPOCH_NS, until_ns, 10_000_000):
            now_s = (now_ns - EPOCH_NS) * 1e-9
            while held and held[0].stamp_ns <= now_ns:
                pipeline.add_packet(held.pop(0), now_s)
            at_us = now_ns // 1000 - 30_000
            if EPOCH_NS // 1000 <= at_us <= bench.track.last_us:
                x_mm = bench.track.position_mm(np.array([at_us]))[0]
                pipeline.placer.add_stage(at_us * 1000, x_mm)
            pipeline.complete(now_s)
            live += sum(len(part) for part in pipeline.place(now_s))
        pipeline.close_period("sweep", now_s)
        for later_s in (0.0, 1.0, 10.0):
            pipeline.complete(now_s + later_s)
            pipeline.place(now_s + later_s)
        report = pipeline.end_scan()
        assert live > 0.8 * len(report.scan.points)
        return pipeline, report

    def errors_mm(self, report):
        """Distance of each point from where the stage really was, and which were at full speed."""
        plain = Reconstructor(
            CALIBRATION, Modulation(FREQUENCY_HZ), Settings(trigger_source="none")
        )
        parts = [plain.push(packet.data) for packet in self.packets]
        profiles = Profiles.concatenate([*parts, plain.flush()])
        true_mm = self.bench.position(self.bench.true.to_ns(profiles.t_us))
        assert len(report.scan.points) == len(profiles)
        order = np.lexsort((profiles.column, profiles.edge_us))
        points = report.scan.points
        np.testing.assert_array_equal(points["column"], profiles.column[order])
        along_mm = points["y"] * 1e3 / CALIBRATION.stage_direction[1]
        ramp_mm = SPEED**2 / (2 * 5000.0) + 2.0
        cruising = (true_mm > 10.0 + ramp_mm) & (true_mm < 110.0 - ramp_mm)
        return along_mm - true_mm[order], cruising[order]


def jitter(t_s, rng):
    return rng.uniform(0.0, 3e6)


def lagging(t_s, rng):
    """Late by up to 1.5 s from the sweep's beginning on."""
    return jitter(t_s, rng) + 1e9 * np.clip((t_s - 4.0) * 3.0, 0.0, 1.5)


@pytest.mark.parametrize("drift", [50e-6, -50e-6])
@pytest.mark.parametrize("delay", [jitter, lagging])
def test_with_edges_of_the_stage_points_are_within_30_um(drift, delay):
    run = Run(drift, delay)
    pipeline, report = run.scan("stage")
    error_mm, cruising = run.errors_mm(report)
    fit = pipeline.stream.epoch.edges.fit
    print(f"seed {SEED}: {np.abs(error_mm[cruising]).max() * 1e3:.1f} um; {fit}")
    assert cruising.sum() > 500
    assert np.abs(error_mm[cruising]).max() < 0.030
    # The odometry's straight lines cut the corners of the ramps: a dt^2 / 8.
    assert np.abs(error_mm).max() < 0.030 + 5000.0 * 0.010**2 / 8
    assert report.points_without_stage == 0
    values = clock_statistics(pipeline.stream)
    assert values["clock"] == "from stage edges"
    assert abs(values["clock_drift_ppm"] - drift * 1e6) < 60.0
    assert values["clock_offset_age_s"] < 5.0
    assert values["stage_edges_used"] + values["stage_edges_missing"] >= 49
    assert values["stage_edges_spurious"] == values["clock_restarts"] == 0


@pytest.mark.parametrize("drift", [50e-6, -50e-6])
@pytest.mark.parametrize("delay", [jitter, lagging])
def test_without_edges_points_are_within_1_mm(drift, delay):
    run = Run(drift, delay)
    pipeline, report = run.scan("none")
    error_mm, _ = run.errors_mm(report)
    print(f"seed {SEED}: {error_mm.min() * 1e3:.1f} to {error_mm.max() * 1e3:.1f} um")
    assert np.abs(error_mm).max() < 1.0
    assert report.points_without_stage == 0
    values = clock_statistics(pipeline.stream)
    assert values["clock"] == "from packet stamps"
    assert abs(values["clock_drift_ppm"] - drift * 1e6) < 60.0
    assert values["clock_residual_ms"] > 0.0


def test_missing_and_spurious_edges_and_odometry_good_to_20_um():
    """The odometry's own error is in the points as well."""
    run = Run(50e-6, jitter, missing=0.05, spurious=4, odometry_mm=0.010)
    pipeline, report = run.scan("stage")
    error_mm, _ = run.errors_mm(report)
    fit = pipeline.stream.epoch.edges.fit
    print(f"seed {SEED}: {error_mm.min() * 1e3:.1f} to {error_mm.max() * 1e3:.1f} um; {fit}")
    assert np.sqrt(np.mean(error_mm**2)) < 0.030
    assert fit.missing > 0
    assert fit.spurious >= 4


def test_without_the_expected_edges_arrivals_give_the_clock():
    run = Run(50e-6, jitter)
    run.packets = Run(50e-6, jitter, missing=1.0).packets
    pipeline, report = run.scan("stage")
    assert np.abs(run.errors_mm(report)[0]).max() < 1.0
    assert pipeline.stream.epoch.edges_missing
