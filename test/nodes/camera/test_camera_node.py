"""The camera node at an emulated bench publishes the sensor's bytes."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from benches import bench_here
from event_camera_msgs.msg import EventPacket
from rclpy.qos import ReliabilityPolicy
from ros_process import Observer, processes, wait_until

from eschorty_ros.core.evt3 import Decoder
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.emulation.bench.devices import Bench
from eschorty_ros.live.device_messages import ns_from_stamp
from eschorty_ros.nodes.ros import qos
from eschorty_ros.nodes.ros.domain import free_domain

MODULE = "eschorty_ros.nodes.camera.node"
CAMERA = {
    "auto_start": False,
    "event_message_size_threshold": 16_000,
    "trigger_in_mode": "external",
    "qos_overrides./eschorty/camera/events.publisher.reliability": "reliable",
}


class Recorder:
    """Records every byte of the sensor, by start of its stream."""

    def __init__(self, bench: Bench) -> None:
        self.runs: list[list[bytes]] = []
        physics = bench.physics
        start, read = physics.start, physics.read

        def watched_start() -> None:
            self.runs.append([])
            start()

        def watched_read(max_bytes: int, timeout_s: float) -> bytes:
            data = read(max_bytes, timeout_s)
            self.runs[-1].append(data)
            return data

        physics.start, physics.read = watched_start, watched_read  # type: ignore[method-assign]


class Capture:
    """Packets of two runs of the stream, the laser lit in the first."""

    def __init__(self, observer: Observer, bench: Bench) -> None:
        profile = qos.events()
        profile.reliability = ReliabilityPolicy.RELIABLE
        self.recorder = Recorder(bench)
        self.packets = observer.collect(EventPacket, "camera/events", profile)
        wait_until(lambda: observer.node.count_publishers("camera/events"), "camera/events")
        observer.wait_for_state("camera", "unconfigured")
        assert observer.change_state("camera", "configure")
        assert observer.change_state("camera", "activate")
        wait_until(lambda: len(self.packets) > 20, "packets")
        with bench.physics.lock:
            bench.physics.set_laser(bench.physics.clock_ns(), True, Modulation(137.0))
        seen = len(self.packets)
        wait_until(lambda: len(self.packets) > seen + 150, "packets of a lit line")
        with bench.physics.lock:
            bench.physics.set_laser(bench.physics.clock_ns(), False, None)
        assert observer.change_state("camera", "deactivate")
        first = len(self.packets)
        assert observer.change_state("camera", "activate")
        wait_until(lambda: len(self.packets) > first + 100, "packets of the second run")
        assert observer.change_state("camera", "deactivate")


@pytest.fixture(scope="module")
def capture() -> Iterator[Capture]:
    domain = free_domain()
    with (
        bench_here(seed=7, background_hz=0.02, trigger="laser") as (bench, folder),
        processes({MODULE: {**CAMERA, "bench": folder}}, domain) as running,
        Observer(domain) as observer,
    ):
        yield Capture(observer, bench)
        assert running["camera"].interrupt() == 0
        assert "Traceback" not in running["camera"].output


def runs(capture: Capture) -> list[list[EventPacket]]:
    """Packets by run of the stream: a new one begins at ``seq`` 0."""
    begins = [k for k, packet in enumerate(capture.packets) if packet.seq == 0]
    return [capture.packets[a:b] for a, b in zip(begins, [*begins[1:], None], strict=True)]


def decoded(data: bytes) -> dict[str, Any]:
    decoder = Decoder()
    events = decoder.decode(data)
    assert decoder.counters.gaps == decoder.counters.unknown_words == 0
    seen = {name: np.array(getattr(events, name)) for name in ("t", "x", "y", "p")}
    return seen | {"trigger": events.triggers.t[events.triggers.edge == 1].copy()}


def test_packets_are_numbered_and_bounded(capture: Capture) -> None:
    assert len(runs(capture)) == 2
    for run in runs(capture):
        assert [packet.seq for packet in run] == list(range(len(run)))
    assert {packet.encoding for packet in capture.packets} == {"evt3"}
    assert {(packet.width, packet.height) for packet in capture.packets} == {(1280, 720)}
    assert not any(packet.is_bigendian for packet in capture.packets)
    sizes = [len(packet.events) for packet in capture.packets]
    assert max(sizes) <= 16_000
    assert all(size % 2 == 0 for size in sizes)
    stamps = [ns_from_stamp(packet.header.stamp) for packet in capture.packets]
    assert stamps == sorted(stamps)


def test_every_byte_of_the_sensor_is_published_in_order(capture: Capture) -> None:
    for run, given in zip(runs(capture), capture.recorder.runs, strict=True):
        published = b"".join(bytes(packet.events) for packet in run)
        sensor = b"".join(given)
        assert sensor.startswith(published)
        print(f"{len(published)} of {len(sensor)} bytes, the rest came after the stop")
        assert len(published) > 0.9 * len(sensor)


def test_sensor_time_restarts_with_every_start(capture: Capture) -> None:
    for run in runs(capture):
        assert decoded(bytes(run[0].events))["t"][0] < 20_000


def test_events_follow_the_triggers_of_the_laser(capture: Capture) -> None:
    seen = decoded(b"".join(bytes(packet.events) for packet in runs(capture)[0]))
    edges, period_us = seen["trigger"], 1e6 / 137.0
    assert len(edges) > 20
    np.testing.assert_allclose(np.diff(edges), period_us, atol=1.0)
    window = (seen["t"] > edges[2]) & (seen["t"] < edges[-2])
    phase = ((seen["t"][window] - edges[0]) % period_us) / period_us
    rising = seen["p"][window] == 1
    assert rising.sum() > 10_000
    assert np.mean(phase[rising] < 0.5) > 0.9
    assert np.mean(phase[~rising] >= 0.5) > 0.9
