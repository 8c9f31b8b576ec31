"""The camera node beside laser and stage, each its own process: it sees both exactly."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy (ROS 2) is not installed")

from eschorty_ros.action import MoveStage
from eschorty_ros.msg import LaserState, StageMotion
from event_camera_msgs.msg import EventPacket
from rclpy.action import ActionClient
from rclpy.qos import ReliabilityPolicy
from ros_process import Observer, processes, wait_until
from sensor_msgs.msg import TimeReference
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger

from eschorty_ros.core.calibration import load_calibration
from eschorty_ros.core.evt3 import Decoder
from eschorty_ros.hardware.protocols import LaserOutput
from eschorty_ros.nodes import qos
from eschorty_ros.nodes.conversions import ns_from_stamp
from eschorty_ros.nodes.device_messages import plan_from_motion, readback_from_state
from eschorty_ros.nodes.domain import free_domain
from eschorty_ros.simulation.scene import named
from eschorty_ros.simulation.world import World

SEED = 7
NODES = "eschorty_ros.nodes."
CAMERA = {
    "scene": "steps",
    "seed": SEED,
    "background_rate": 0.02,
    "auto_start": False,
    "event_message_size_threshold": 16_000,
    "qos_overrides./eschorty/camera/events.publisher.reliability": "reliable",
}


class Capture:
    """Everything said on the topics during one short run."""

    def __init__(self, observer: Observer) -> None:
        profile = qos.events()
        profile.reliability = ReliabilityPolicy.RELIABLE
        self.observer = observer
        self.packets = observer.collect(EventPacket, "camera/events", profile)
        self.clocks = observer.collect(TimeReference, "camera/clock", qos.latched())
        self.lasers = observer.collect(LaserState, "laser/state", qos.latched(qos.STATE_HISTORY))
        self.motions = observer.collect(StageMotion, "stage/motion", qos.stream(1000))

    def run(self) -> None:
        """Laser on, a move, another frequency, laser off."""
        observer = self.observer
        heart = observer.publisher(Header, "laser/heartbeat", qos.stream(10))
        timer = observer.node.create_timer(0.1, lambda: heart.publish(Header()))
        wait_until(lambda: observer.node.count_publishers("camera/events"), "camera/events")
        for node in ("laser", "stage"):
            observer.wait_for_state(node, "active")
        observer.wait_for_state("camera", "unconfigured")
        time.sleep(0.5)
        assert observer.change_state("camera", "configure")
        assert observer.change_state("camera", "activate")
        client = ActionClient(observer.node, MoveStage, "stage/move")
        wait_until(client.server_is_ready, "stage/move")
        assert observer.call(Trigger, "laser/arm").success
        assert observer.call(SetBool, "laser/enable", SetBool.Request(data=True)).success
        sent = client.send_goal_async(MoveStage.Goal(position=0.03, speed=0.05))
        time.sleep(0.3)
        accepted, reason = observer.set_parameter("laser", "frequency", 137.0)
        assert accepted, reason
        wait_until(sent.done, "the goal's acceptance")
        moved = sent.result().get_result_async()
        wait_until(moved.done, "the move's end")
        assert observer.call(SetBool, "laser/enable", SetBool.Request(data=False)).success
        time.sleep(0.3)
        assert observer.change_state("camera", "deactivate")
        observer.node.destroy_timer(timer)
        client.destroy()

    @property
    def zero_ns(self) -> int:
        """ROS time of sensor time 0."""
        return ns_from_stamp(self.clocks[-1].header.stamp)


@pytest.fixture(scope="module")
def capture() -> Iterator[Capture]:
    domain = free_domain()
    nodes = {NODES + "laser": {}, NODES + "stage": {}, NODES + "camera": CAMERA}
    with processes(nodes, domain) as running, Observer(domain, "camera_observer") as observer:
        capture = Capture(observer)
        capture.run()
        yield capture
        assert {name: process.interrupt() for name, process in running.items()} == {
            "laser": 0,
            "stage": 0,
            "camera": 0,
        }
        assert not [p.output for p in running.values() if "Traceback" in p.output]


def decoded(data: bytes) -> dict[str, Any]:
    events = Decoder().decode(data)
    return {name: np.array(getattr(events, name)) for name in ("t", "x", "y", "p")}


def ceil_us(t_ns: int, zero_ns: int) -> int:
    return max(-((zero_ns - t_ns) // 1000), 0)


def offline_events(capture: Capture, until_us: int) -> dict[str, Any]:
    """The same world without any node: laser and stage as they reported themselves."""
    zero_ns = capture.zero_ns
    world = World(named("steps"), load_calibration("config_3"), seed=SEED, background_hz=0.02)
    for readback in dict.fromkeys(readback_from_state(m) for m in capture.lasers):
        on = readback.output is not LaserOutput.OFF
        since_ns = readback.output_since_ns
        if on:
            since_ns = max(since_ns, readback.phase_epoch_ns)
        edge_us = (readback.phase_epoch_ns - zero_ns + 500) // 1000
        modulation = replace(readback.modulation, on_edge_us=edge_us)
        world.set_laser(ceil_us(since_ns, zero_ns), on, modulation)
    for plan in dict.fromkeys(plan_from_motion(m) for m in capture.motions):
        world.set_stage(plan, zero_ns, ceil_us(plan.start_ns, zero_ns))
    return decoded(world.advance(until_us))


def test_packets_are_numbered_and_bounded(capture: Capture) -> None:
    assert [packet.seq for packet in capture.packets] == list(range(len(capture.packets)))
    assert {packet.encoding for packet in capture.packets} == {"evt3"}
    assert {(packet.width, packet.height) for packet in capture.packets} == {(1280, 720)}
    assert not any(packet.is_bigendian for packet in capture.packets)
    sizes = [len(packet.events) for packet in capture.packets]
    assert max(sizes) <= 16_000
    assert all(size % 2 == 0 for size in sizes)
    stamps = [ns_from_stamp(packet.header.stamp) for packet in capture.packets]
    assert stamps == sorted(stamps)


def test_events_equal_an_offline_world_of_the_same_laser_and_stage(capture: Capture) -> None:
    assert len({m.output_since.nanosec for m in capture.lasers}) >= 4
    online = decoded(b"".join(bytes(packet.events) for packet in capture.packets))
    last_us = int(online["t"][-1])
    offline = offline_events(capture, last_us + 20_000)
    count = online["t"].size
    print(f"seed {SEED}: {count} events over {last_us * 1e-6:.2f} s of sensor time")
    assert count > 50_000
    for name in online:
        np.testing.assert_array_equal(online[name], offline[name][:count], err_msg=name)


def test_rising_edges_show_at_the_commanded_times(capture: Capture) -> None:
    online = decoded(b"".join(bytes(packet.events) for packet in capture.packets))
    lit = [readback_from_state(m) for m in capture.lasers if m.output == LaserState.OUTPUT_ON]
    readback = next(r for r in lit if r.modulation.frequency_hz == 137.0)
    epoch_us = (readback.phase_epoch_ns - capture.zero_ns + 500) // 1000
    period_us = readback.modulation.period_us
    window = (online["t"] > epoch_us) & (online["t"] < epoch_us + 20 * period_us)
    phase = ((online["t"][window] - epoch_us) % period_us) / period_us
    rising = online["p"][window] == 1
    assert np.mean(phase[rising] < 0.5) > 0.9
    assert np.mean(phase[~rising] >= 0.5) > 0.9
