"""Settings that the EVK4 driver makes on the emulated camera, and their effect on the events."""

from pathlib import Path

import numpy as np
import pytest
from camera_on_bench import CameraOnBench
from evk4_bench import OnDemand

from eschorty_ros.emulation.bench.devices import sensor_control
from eschorty_ros.emulation.evk4 import Evk4Model
from eschorty_ros.emulation.evk4.registers import FACTORY_DACS
from eschorty_ros.hardware.camera import BIASES, CameraSettings
from eschorty_ros.simulation.pixels import Biases
from eschorty_ros.simulation.world import SensorControl

OFF, ON = 0, 1


def stepped(setup: CameraOnBench, name: str, offsets: tuple[int, ...], ms: int) -> list[np.ndarray]:
    """OFF and ON events at each of these offsets, set while the camera streams."""
    counts = []
    for offset in offsets:
        assert setup.camera.set_bias(name, offset) == offset
        assert setup.camera.read_biases()[name] == offset
        setup.counts(10)
        counts.append(setup.counts(ms))
    print(name, dict(zip(offsets, [count.tolist() for count in counts], strict=True)))
    return counts


def test_default_settings_simulate_the_sensor_as_delivered(tmp_path: Path) -> None:
    with CameraOnBench(tmp_path) as setup:
        assert sensor_control(setup.bench.camera.settings) == SensorControl()


@pytest.mark.parametrize(
    ("name", "polarity", "offsets"),
    [("bias_diff_on", ON, (-60, -20, 0, 60, 140)), ("bias_diff_off", OFF, (-35, 0, 60, 180))],
)
def test_raising_a_threshold_lowers_its_events_step_by_step(
    tmp_path: Path, name: str, polarity: int, offsets: tuple[int, ...]
) -> None:
    with CameraOnBench(tmp_path) as setup:
        setup.light(500.0)
        setup.counts(20)
        counts = [int(count[polarity]) for count in stepped(setup, name, offsets, 40)]
        assert counts == sorted(counts, reverse=True)
        assert counts[-1] < 0.75 * counts[offsets.index(0)] < 0.75 * counts[0]
        again = stepped(setup, name, (0,), 40)[0][polarity]
        assert again == pytest.approx(counts[offsets.index(0)], rel=0.03)


@pytest.mark.parametrize(
    ("name", "frequency_hz", "offsets", "factor"),
    [("bias_fo", 10_000.0, (-30, -10, 10), 2.0), ("bias_refr", 2000.0, (0, 60, 180), 1.5)],
    ids=["wider follower at 10 kHz", "shorter dead time at 2 kHz"],
)
def test_a_faster_pixel_gives_more_events_step_by_step(
    tmp_path: Path, name: str, frequency_hz: float, offsets: tuple[int, ...], factor: float
) -> None:
    with CameraOnBench(tmp_path) as setup:
        setup.light(frequency_hz)
        setup.counts(20)
        counts = [int(c.sum()) for c in stepped(setup, name, offsets, 20)]
        assert counts == sorted(counts)
        assert counts[-1] > factor * counts[0]


def test_the_high_pass_bias_changes_nothing(tmp_path: Path) -> None:
    with CameraOnBench(tmp_path) as setup:
        setup.light(70.0)
        setup.counts(20)
        counts = [int(c.sum()) for c in stepped(setup, "bias_hpf", (0, 120), 100)]
        assert counts[1] == pytest.approx(counts[0], rel=0.02)


def test_biases_set_before_the_start_act_on_the_first_event(tmp_path: Path) -> None:
    counts = []
    for given in (CameraSettings(), CameraSettings(biases={"bias_diff_on": 120})):
        with CameraOnBench(tmp_path, given) as setup:
            setup.light(500.0)
            counts.append(int(setup.counts(40)[ON]))
    print(counts)
    assert counts[1] < 0.8 * counts[0]


def test_offsets_beyond_the_normal_range_act_as_its_end() -> None:
    seen = []
    model = Evk4Model(OnDemand())
    model.configure = lambda settings: seen.append(sensor_control(settings))
    fo = BIASES["bias_fo"]
    model.write(fo.address, 0x11A10000 | FACTORY_DACS["bias_fo"] + 90)
    assert seen[-1] == SensorControl(Biases(fo=fo.normal[1]))
    model.power_up()
    assert seen[-1] == SensorControl()


def test_the_rate_control_keeps_its_rate_and_counts_dropped_events(tmp_path: Path) -> None:
    with CameraOnBench(tmp_path, CameraSettings(erc_rate=300_000)) as setup:
        setup.light(500.0)
        setup.counts(100)
        times_us = np.array(setup.times_us)
        delivered, dropped = setup.statistic("events"), setup.statistic("rate_dropped")
        counters = setup.decoder.counters
        print(f"{delivered} delivered, {dropped} dropped, {counters}")
        assert np.bincount(times_us // 200).max() == 60
        assert dropped > 0.5 * delivered
        # The period in progress is not reported yet.
        unreported = np.count_nonzero(times_us >= times_us[-1] // 200 * 200)
        assert 0 <= delivered - counters.erc_events_out <= unreported
        reported = counters.erc_events_in - counters.erc_events_out
        assert 0 <= dropped - reported < 0.02 * dropped
        assert counters.sensor_drop_words == 0


def test_limited_and_free_cameras_make_the_same_events(tmp_path: Path) -> None:
    made = []
    for rate in (None, 300_000):
        with CameraOnBench(tmp_path, CameraSettings(erc_rate=rate)) as setup:
            setup.light(500.0)
            setup.counts(50)
            made.append(setup.statistic("events") + setup.statistic("rate_dropped"))
            assert (setup.statistic("rate_dropped") > 0) == (rate is not None)
    print(made)
    assert made[0] == made[1]


@pytest.mark.parametrize(("set_us", "packet_us"), [(None, 4000), (2000, 2000)])
def test_packets_of_the_bench_last_as_the_camera_is_set(
    tmp_path: Path, set_us: int | None, packet_us: int
) -> None:
    with CameraOnBench(tmp_path, CameraSettings(packet_period_us=set_us)) as setup:
        assert setup.bench.physics.packet_us == packet_us
