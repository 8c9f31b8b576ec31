"""The bench's physics: laser, stage and sensor, each with its clock, without device models."""

import random
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from awg_bench import Clock

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.clocks import MotionPlan, plan_move
from eschorty_ros.core.evt3 import Decoder
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.emulation.bench.physics import Imperfections, Physics
from eschorty_ros.simulation.scenes import Plane
from eschorty_ros.simulation.world import World

SEED = 20240611
MS = 1_000_000
CALIBRATION = replace(load_calibration("config_3"), columns=64, principal_column=31.5)


def world() -> World:
    return World(Plane(1320.0, slope_stage=1.0), CALIBRATION, seed=SEED)


def started(*imperfections: Any, make: Callable[[], World] = world) -> tuple[Clock, Physics]:
    """A running sensor, and the clock of everything."""
    clock = Clock()
    physics = Physics(make, clock, *imperfections)
    physics.start()
    return clock, physics


def drained(physics: Physics, max_bytes: int = 1 << 20) -> bytes:
    """All bytes up to now: a read that returns none may have simulated a part of a packet."""
    parts, behind_s = [], None
    while behind_s != physics.statistics()["behind_s"]:
        behind_s = physics.statistics()["behind_s"]
        parts += iter(lambda: physics.read(max_bytes, 0.0), b"")
    return b"".join(parts)


def history(zero_ns: int, physics: Physics) -> list[tuple[int, object]]:
    """Changes of laser and stage in a run of 400 ms."""
    move = plan_move(zero_ns + 60 * MS + 500_001, 0.0, 20.0, 200.0, 2000.0)
    return [
        (31 * MS + 77, lambda t: physics.set_laser(t, True, Modulation(100.0))),
        (60 * MS + 500_001, lambda t: physics.set_stage(move)),
        (200 * MS + 3, lambda t: physics.set_stage(MotionPlan(t, float(move.state(t)[0])))),
        (260 * MS + 999, lambda t: physics.set_laser(t, True, Modulation(150.0))),
        (330 * MS + 5, lambda t: physics.set_laser(t, False, None)),
    ]


def run(read_every_ns: int, max_bytes: int) -> tuple[bytes, Physics]:
    """The bytes of the run, read every ``read_every_ns``."""
    clock, physics = started()
    zero_ns, out = clock.now_ns, []
    changes = history(zero_ns, physics)
    reads = range(read_every_ns, 400 * MS + read_every_ns, read_every_ns)
    for at_ns, change in sorted([*changes, *((t, None) for t in reads)], key=lambda e: e[0]):
        clock.now_ns = zero_ns + at_ns
        if change is None:
            out.append(drained(physics, max_bytes))
        else:
            change(clock.now_ns)
    return b"".join(out), physics


def test_bytes_do_not_depend_on_the_times_of_the_reads() -> None:
    streams = [run(*how) for how in ((MS, 1 << 20), (7 * MS, 1000), (90 * MS, 1 << 17))]
    shortest = min(len(data) for data, _ in streams)
    reference, physics = streams[0]
    assert physics.statistics()["events"] > 20_000
    assert shortest > 0.9 * len(reference)
    for data, physics in streams:
        assert data[:shortest] == reference[:shortest]
        assert physics.late_changes == 0


@pytest.mark.parametrize("packet_us", [2000, 4000])
def test_a_packet_leaves_at_the_end_of_its_period(packet_us: int) -> None:
    clock, physics = started()
    physics.packet_us = packet_us
    physics.set_laser(clock.now_ns, True, Modulation(1000.0))
    zero_ns, before = clock.now_ns, 0
    for end_us in range(packet_us, 5 * packet_us, packet_us):
        clock.now_ns = zero_ns + end_us * 1000 - 1
        assert physics.read(1 << 20, 0.0) == b""
        clock.now_ns += 1
        data = physics.read(1 << 20, 0.0)
        assert data
        assert physics.late_ns == 0
        assert physics.statistics()["events"] > before
        before = physics.statistics()["events"]


def test_edges_lie_where_the_generator_puts_them_in_the_sensors_time() -> None:
    made = []
    clock, physics = started(make=lambda: made.append(world()) or made[-1])
    clock.now_ns += 3 * MS + 400_900
    physics.set_laser(clock.now_ns, True, Modulation(100.0))
    clock.now_ns += 97 * MS
    drained(physics)
    lit_us = np.unique(made[-1].truth["t_us"])
    assert lit_us.tolist() == [3_400 + 2_500 + 10_000 * k for k in range(10)]


@pytest.mark.parametrize(("sensor_ppm", "generator_ppm"), [(50.0, 0.0), (0.0, -40.0), (50.0, 50.0)])
def test_clocks_drift_apart(sensor_ppm: float, generator_ppm: float) -> None:
    clock, physics = started(Imperfections(sensor_ppm, generator_ppm), "laser")
    physics.set_laser(clock.now_ns, True, Modulation(100.0))
    edges: list[int] = []
    decoder = Decoder(64, 720)
    for _ in range(100):
        clock.now_ns += 10 * MS
        triggers = decoder.decode(drained(physics)).triggers
        edges += triggers.t[triggers.edge == 1].tolist()
    expected = 10_000 * (1.0 + (sensor_ppm - generator_ppm) * 1e-6)
    assert len(edges) >= 99
    assert np.abs(edges - expected * np.arange(len(edges))).max() <= 1.0


def test_stage_pulses_before_a_new_command_arrive_as_triggers() -> None:
    clock = Clock()
    zero_ns = clock.now_ns
    pulses = [(zero_ns + k * 20 * MS + j * MS, not j) for k in range(1, 10) for j in (0, 1)]
    stopped_ns = [zero_ns + 1000 * MS]

    def output(from_ns: int, until_ns: int) -> list[tuple[int, bool]]:
        return [e for e in pulses if from_ns <= e[0] < min(until_ns, stopped_ns[0])]

    physics = Physics(world, clock, Imperfections(sensor_ppm=100.0), "stage", output)
    physics.start()
    clock.now_ns += 110 * MS
    physics.collect_pulses()
    stopped_ns[0] = 0  # a new command drops the old one's pulses
    clock.now_ns += 90 * MS
    triggers = Decoder(64, 720).decode(drained(physics)).triggers
    seen = [((t_ns - zero_ns) * 10001 // 10_000_000, rising) for t_ns, rising in pulses[:10]]
    assert list(zip(triggers.t.tolist(), triggers.edge.tolist(), strict=True)) == seen
    assert physics.statistics()["trigger_edges"] == 10


def test_missing_edges_are_counted() -> None:
    clock, physics = started(Imperfections(missing_edges=0.1, seed=SEED), "laser")
    physics.set_laser(clock.now_ns, True, Modulation(1000.0))
    decoder = Decoder(64, 720)
    seen = 0
    for _ in range(10):
        clock.now_ns += 50 * MS
        seen += len(decoder.decode(drained(physics)).triggers)
    counted = physics.statistics()
    assert counted["trigger_edges"] - counted["trigger_edges_missed"] == seen
    assert 0.06 < counted["trigger_edges_missed"] / counted["trigger_edges"] < 0.14


def test_jitter_delays_bytes_and_changes_no_byte() -> None:
    def stream(jitter_ms: float) -> tuple[bytes, list[int]]:
        clock, physics = started(Imperfections(usb_jitter_ms=jitter_ms, seed=SEED))
        physics.set_laser(clock.now_ns, True, Modulation(100.0))
        out, sizes = [], []
        for _ in range(200):
            clock.now_ns += MS
            out.append(drained(physics))
            sizes.append(len(out[-1]))
        return b"".join(out), sizes

    prompt, sizes = stream(0.0)
    late, late_sizes = stream(3.0)
    assert prompt.startswith(late)
    assert len(late) > 0.95 * len(prompt)
    behind = np.cumsum(sizes) - np.cumsum(late_sizes)
    assert behind.min() >= 0
    assert behind.max() > 0


def test_a_new_start_begins_at_zero_with_laser_and_stage_as_they_are() -> None:
    made: list[World] = []
    clock, physics = started(make=lambda: made.append(world()) or made[-1])
    physics.set_laser(clock.now_ns, True, Modulation(100.0))
    physics.set_stage(plan_move(clock.now_ns, 0.0, 20.0, 100.0, 2000.0))
    clock.now_ns += 50 * MS
    assert drained(physics)
    physics.stop()
    physics.stop()
    assert physics.read(1000, 0.0) == b""
    clock.now_ns += 5_003 * MS
    physics.start()
    clock.now_ns += 20 * MS
    times = Decoder(64, 720).decode(drained(physics)).t
    assert len(made) == 2
    assert times[0] < 5_000
    assert made[1].stage_mm(10_000) == 20.0
    # 5.053 s after a rising edge: the light has been on for 3 ms.
    assert made[1].laser_edges(0, 20_000) == [(0, True), (2_000, False), (7_000, True),
                                              (12_000, False), (17_000, True)]  # fmt: skip
    assert physics.late_changes == 0


def test_bytes_that_come_late_know_by_how_much() -> None:
    clock, physics = started()
    clock.now_ns += 500 * MS
    late_ns = []
    while physics.read(1 << 20, 0.0):
        late_ns.append(physics.late_ns)
    assert late_ns == sorted(late_ns, reverse=True)
    assert late_ns[0] > 400 * MS
    # The packets of a dark scene come together.
    assert 0 <= late_ns[-1] < 32 * MS


def test_reads_end_although_a_packet_takes_long_to_simulate() -> None:
    modulation = Modulation(5000.0)

    def bytes_of(make: Callable[[], World]) -> tuple[list[bytes], Physics]:
        clock, physics = started(make=make)
        physics.set_laser(clock.now_ns, True, modulation)
        clock.now_ns += 8 * MS
        return [physics.read(1 << 20, 0.0) for _ in range(60)], physics

    def slow() -> World:
        made = world()
        advance = made.advance

        def late(until_us: int) -> bytes:
            time.sleep((until_us - made.now_us) * 20e-6)
            return advance(until_us)

        made.advance = late  # type: ignore[method-assign]
        return made

    reads, physics = bytes_of(slow)
    # 20 ms per period, so that a read ends before a packet of 4 ms does; its bytes come whole.
    assert reads[0] == b""
    assert b"".join(reads) == b"".join(bytes_of(world)[0]) != b""
    assert physics.read(1 << 20, 0.0) == b""


def test_late_changes_are_counted() -> None:
    clock, physics = started()
    clock.now_ns += 50 * MS
    drained(physics)
    physics.set_laser(clock.now_ns - 30 * MS, True, Modulation(100.0))
    drained(physics)
    clock.now_ns += 50 * MS
    drained(physics)
    assert physics.late_changes == 1


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: Imperfections(sensor_ppm=2000.0), "sensor_ppm is 2000.0"),
        (lambda: Imperfections(usb_jitter_ms=-1.0), "usb_jitter_ms is -1.0"),
        (lambda: Imperfections(missing_edges=float("nan")), "missing_edges is nan"),
        (lambda: Physics(world, Clock(), trigger="camera"), "trigger is 'camera'"),
    ],
)
def test_bad_values_are_refused(make, named: str) -> None:
    with pytest.raises(ArgumentError, match=named):
        make()


def test_reading_from_a_thread_while_devices_act() -> None:
    clock, physics = started()
    rng = random.Random(SEED)
    total = 0
    for _ in range(50):
        clock.now_ns += rng.randint(0, 5) * MS
        with physics.lock:
            physics.set_laser(physics.clock_ns(), rng.random() < 0.5, Modulation(100.0))
        total += len(physics.read(1 << 17, 0.0))
    assert total
    assert physics.late_changes == 0
