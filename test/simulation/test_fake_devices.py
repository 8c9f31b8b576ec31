"""The emulated laser, stage and camera."""

from __future__ import annotations

import random
import threading

import numpy as np
import pytest

from eschorty_ros.core.calibration import load_calibration
from eschorty_ros.core.errors import DeviceError
from eschorty_ros.core.evt3 import Decoder
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.motion import MotionPlan
from eschorty_ros.hardware.protocols import EventChunk, LaserOutput, LaserReadback
from eschorty_ros.simulation.devices import FakeCamera, FakeLaser, FakeStage
from eschorty_ros.simulation.pixel_parameters import PixelParameters
from eschorty_ros.simulation.scene import Plane
from eschorty_ros.simulation.world import World

SEED = 20240611
MS = 1_000_000
CALIBRATION = load_calibration("config_3").model_copy(
    update={"columns": 64, "principal_column": 31.5}
)


class Clock:
    """A clock that stands still until told."""

    def __init__(self, now_ns: int = 1_700_000_000_123_456_789) -> None:
        self.now_ns = now_ns

    def __call__(self) -> int:
        return self.now_ns


def small_world() -> World:
    return World(Plane(1320.0, slope_stage=1.0), CALIBRATION, seed=SEED)


def test_laser_is_off_until_armed_and_enabled() -> None:
    clock = Clock()
    laser = FakeLaser(clock)
    assert laser.readback().output is LaserOutput.OFF
    with pytest.raises(DeviceError, match="not armed"):
        laser.enable()
    clock.now_ns += 5 * MS
    laser.configure(Modulation(100.0, 0.3))
    laser.arm()
    clock.now_ns += 5 * MS
    laser.enable()
    told = laser.readback()
    assert told == LaserReadback(
        LaserOutput.ON, Modulation(100.0, 0.3), clock.now_ns - 5 * MS, clock.now_ns
    )
    clock.now_ns += MS
    laser.configure(Modulation(200.0))
    assert laser.readback().phase_epoch_ns == laser.readback().output_since_ns == clock.now_ns
    laser.disable()
    laser.disable()
    assert laser.readback().output is LaserOutput.OFF
    with pytest.raises(DeviceError, match="not armed"):
        laser.enable()
    laser.configure(Modulation(100.0, waveform="sine"))
    assert laser.readback().modulation.waveform == "sine"


def test_laser_log_tells_every_change_at_once(tmp_path) -> None:
    clock = Clock(1000)
    log = tmp_path / "laser.log"
    laser = FakeLaser(clock, log)
    laser.arm()
    clock.now_ns = 2000
    laser.enable()
    assert log.read_text() == "1000 OFF\n2000 ON\n"
    clock.now_ns = 3000
    laser.close()
    laser.close()
    assert log.read_text() == "1000 OFF\n2000 ON\n3000 OFF\n"
    with pytest.raises(DeviceError, match="closed"):
        laser.arm()
    with pytest.raises(DeviceError, match="cannot write the laser log"):
        FakeLaser(clock, tmp_path / "missing" / "laser.log")


def test_stage_homes_moves_and_stops_with_its_plan() -> None:
    clock = Clock()
    stage = FakeStage(clock)
    with pytest.raises(DeviceError, match="not homed"):
        stage.move_to(10.0, 50.0)
    stage.home()
    assert "homing" in stage.state().flags
    assert not stage.state().homed
    with pytest.raises(DeviceError, match="moving"):
        stage.move_to(10.0, 50.0)
    clock.now_ns = stage.plan().end_ns
    assert stage.state().homed
    assert "at_lower_limit" in stage.state().flags
    for position, speed, words in (
        (220.1, 50.0, "travel"),
        (10.0, 301.0, "speed_mm_s"),
        (-0.1, 50.0, "travel"),
        (10.0, 0.0, "speed_mm_s"),
        (float("nan"), 50.0, "travel"),
    ):
        with pytest.raises(DeviceError, match=words):
            stage.move_to(position, speed)
    stage.move_to(100.0, 300.0)
    clock.now_ns += 200 * MS
    moving = stage.state()
    assert moving.moving
    assert moving.velocity_mm_s == pytest.approx(300.0)
    stage.stop()
    clock.now_ns += 150 * MS
    halted = stage.state()
    assert not halted.moving
    assert halted.velocity_mm_s == 0.0
    assert halted.position_mm == pytest.approx(moving.position_mm + 300.0**2 / 2 / 2000.0)
    stage.stop()
    stage.move_to(100.0, 300.0)
    clock.now_ns = stage.plan().end_ns
    assert stage.state().position_mm == pytest.approx(100.0, abs=1e-9)


def test_stopped_homing_leaves_the_stage_unhomed() -> None:
    clock = Clock()
    stage = FakeStage(clock)
    stage.home()
    clock.now_ns += 20 * MS
    stage.stop()
    clock.now_ns += 1000 * MS
    assert not stage.state().homed


def history(clock: Clock) -> list[tuple[int, str]]:
    """Times at which laser and stage change, in a run of 400 ms."""
    zero = clock.now_ns
    return [
        (zero + 30 * MS + 1234, "configure"),
        (zero + 31 * MS + 77, "enable"),
        (zero + 60 * MS + 500_001, "move"),
        (zero + 200 * MS + 3, "stop"),
        (zero + 260 * MS + 999, "reconfigure"),
        (zero + 330 * MS + 5, "disable"),
    ]


def drive(delay_ns: int, every_ns: int, seed: int) -> tuple[bytes, dict[str, float]]:
    """The camera's bytes when reports come every ``every_ns``, each late by up to ``delay_ns``."""
    rng = random.Random(seed)
    clock = Clock()
    laser, stage = FakeLaser(clock), FakeStage(clock)
    stage.home()
    clock.now_ns = stage.plan().end_ns
    camera = FakeCamera(small_world(), clock)
    camera.start()
    zero = camera.sensor_zero_ns()
    act = {
        "configure": lambda: (laser.configure(Modulation(100.0)), laser.arm()),
        "enable": laser.enable,
        "move": lambda: stage.move_to(100.0, 200.0),
        "stop": stage.stop,
        "reconfigure": lambda: laser.configure(Modulation(150.0)),
        "disable": laser.disable,
    }
    pending = history(clock)
    mail: list[tuple[int, str, object, int]] = []
    arrival = {"laser": 0, "stage": 0}
    out = []

    def report() -> None:
        for name, content in (("laser", laser.readback()), ("stage", stage.plan())):
            arrival[name] = max(arrival[name], clock.now_ns + rng.randint(0, delay_ns))
            mail.append((arrival[name], name, content, clock.now_ns))

    def deliver() -> None:
        mail.sort(key=lambda item: item[0])
        while mail and mail[0][0] <= clock.now_ns:
            _, name, content, confirmed = mail.pop(0)
            (camera.observe_laser if name == "laser" else camera.observe_stage)(content, confirmed)
        while chunk := camera.read(0.0):
            out.append(chunk.data)

    end = zero + 400 * MS
    while clock.now_ns < end + delay_ns + every_ns:
        tick = clock.now_ns + every_ns
        while pending and pending[0][0] <= tick:
            clock.now_ns, name = pending.pop(0)
            act[name]()
            report()
            deliver()
        clock.now_ns = tick
        report()
        deliver()
    return b"".join(out), camera.statistics()


def test_bytes_do_not_depend_on_message_delays_or_batching() -> None:
    streams = [drive(*how) for how in ((0, MS, 1), (40 * MS, 7 * MS, 2), (400 * MS, 50 * MS, 3))]
    shortest = min(len(data) for data, _ in streams)
    reference, statistics = streams[0]
    assert statistics["events"] > 20_000
    assert shortest > 0.9 * len(reference)
    for data, counted in streams:
        assert data[:shortest] == reference[:shortest]
        for name in (
            "laser_silences",
            "stage_silences",
            "laser_late_changes",
            "stage_late_changes",
            "reports_out_of_order",
        ):
            assert counted[name] == 0.0, name


def test_camera_sees_laser_edges_to_the_microsecond() -> None:
    clock = Clock()
    camera = FakeCamera(small_world(), clock)
    camera.start()
    zero = camera.sensor_zero_ns()
    epoch = zero + 3 * MS + 400
    readback = LaserReadback(LaserOutput.ON, Modulation(100.0), epoch, zero - 5)
    clock.now_ns += 100 * MS
    camera.observe_stage(MotionPlan(zero, 0.0), clock.now_ns)
    camera.observe_laser(readback, clock.now_ns)
    while camera.read(0.0):
        pass
    lit_us = camera._world.truth["t_us"]
    assert np.unique(lit_us).tolist() == [3_000 + 2_500 + 10_000 * k for k in range(10)]


def test_silence_leaves_the_laser_dark_and_is_counted() -> None:
    clock = Clock()
    world = World(Plane(1320.0), CALIBRATION, PixelParameters(noise=0.0), SEED, 0.0)
    camera = FakeCamera(world, clock)
    camera.start()
    zero = camera.sensor_zero_ns()
    on = LaserReadback(LaserOutput.ON, Modulation(100.0), zero, zero)
    rest = MotionPlan(zero, 3.0)

    def run_to(ms: int, laser: bool) -> bytes:
        out = b""
        while clock.now_ns < zero + ms * MS:
            clock.now_ns += 20 * MS
            camera.observe_stage(rest, clock.now_ns)
            if laser:
                camera.observe_laser(on, clock.now_ns)
            while chunk := camera.read(0.0):
                out += chunk.data
        return out

    run_to(200, laser=True)
    assert camera.statistics()["events"] > 0
    assert run_to(1000, laser=False) == b""
    assert world.now_us == 200_000
    run_to(2000, laser=False)
    assert world.now_us == 1_000_000
    seen = camera.statistics()["events"]
    run_to(2200, laser=False)
    assert camera.statistics()["events"] == seen
    assert camera.statistics()["laser_silences"] == 1.0
    run_to(2500, laser=True)
    assert world.now_us == 2_500_000
    assert camera.statistics()["events"] > seen
    assert camera.statistics()["stage_silences"] == 0.0


def test_read_waits_for_news_and_stop_ends_the_stream() -> None:
    clock = Clock()
    camera = FakeCamera(small_world(), clock)
    camera.start()
    zero = camera.sensor_zero_ns()
    got: list[EventChunk | None] = []
    reader = threading.Thread(target=lambda: got.append(camera.read(20.0)))
    reader.start()
    clock.now_ns += 50 * MS
    off = LaserReadback(LaserOutput.OFF, Modulation(70.0), zero, zero)
    camera.observe_laser(off, clock.now_ns)
    camera.observe_stage(MotionPlan(zero, 0.0), clock.now_ns)
    reader.join(20.0)
    assert got
    assert got[0]
    camera.stop()
    camera.stop()
    assert camera.read(0.0) is None
    camera.start()
    assert camera.sensor_zero_ns() > zero
    camera.close()
    with pytest.raises(DeviceError, match="closed"):
        camera.read(0.0)


def test_sensor_time_goes_on_after_a_restart() -> None:
    clock = Clock()
    camera = FakeCamera(small_world(), clock)
    camera.start()
    zero = camera.sensor_zero_ns()
    on = LaserReadback(LaserOutput.ON, Modulation(100.0), zero, zero)
    decoder = Decoder(64, 720)
    times: list[int] = []

    def run(ms: int) -> None:
        for _ in range(ms // 10):
            clock.now_ns += 10 * MS
            camera.observe_laser(on, clock.now_ns)
            camera.observe_stage(MotionPlan(zero, 0.0), clock.now_ns)
            while chunk := camera.read(0.0):
                times.extend(decoder.decode(chunk.data).t.tolist())

    run(100)
    camera.stop()
    clock.now_ns += 5_000 * MS
    camera.start()
    run(100)
    assert camera.statistics()["sensor_time_s"] == pytest.approx(0.2)
    assert camera.statistics()["laser_late_changes"] == 0.0
    gaps = np.diff(times)
    assert gaps.min() >= 0
    assert gaps.max() < 10_000
