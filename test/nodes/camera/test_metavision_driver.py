"""metavision_driver as the camera: the same points as from our node's packets."""

from dataclasses import replace

import numpy as np
import pytest
from eschorty_ros.msg import ReconstructionState
from eschorty_ros.srv import BeginScan, EndScan
from event_camera_msgs.msg import EventPacket
from nav_msgs.msg import Odometry
from packet_driver import METAVISION, OURS, Driver
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_process import NodeProcess, Observer, Remap, wait_until
from sensor_msgs.msg import PointCloud2
from tf2_msgs.msg import TFMessage

from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.core.reconstruction import reconstruct_recording, stage_speed_mm_s
from eschorty_ros.live.device_messages import ns_from_stamp
from eschorty_ros.nodes.ros import qos
from eschorty_ros.nodes.ros.cloud_messages import points_from_message
from eschorty_ros.nodes.ros.conversions import stamp_from_ns
from eschorty_ros.simulation.scenes import named
from eschorty_ros.simulation.world import simulate_recording

SPEED_MM_S = 20.0
# Stamps are up to a packet's age late, and a packet's first bytes are 1 ms older than its stamp.
CLOCK_S = 0.006
AHEAD = 32


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    made = simulate_recording(
        tmp_path_factory.mktemp("driver") / "rec",
        named("steps"),
        load_calibration("config_3"),
        start_mm=30.0,
        stop_mm=38.0,
        speed_mm_s=SPEED_MM_S,
        seed=12,
    )
    # A camera does not know the laser's edges.
    return replace(made, modulation=Modulation(70.0))


def publish(driver: Driver, observer: Observer, recording, states) -> None:
    """Publish stage and packets; stay a bounded number ahead, as best effort loses a burst."""
    camera = Node(driver.node, context=observer.node.context)
    reliability = ReliabilityPolicy[driver.reliability.upper()]
    events = camera.create_publisher(
        EventPacket, driver.topic, QoSProfile(depth=1000, reliability=reliability)
    )
    wait_until(events.get_subscription_count, "a subscriber of the driver")
    odometry = observer.publisher(Odometry, "/my_stage/odom", qos.stream(2000))
    placed = observer.collect(TFMessage, "/tf", qos.stream())
    zero_ns = observer.node.get_clock().now().nanoseconds
    for t_us, position_mm in recording.stage_samples.tolist():
        message = Odometry()
        message.header.stamp = stamp_from_ns(zero_ns + 1000 * t_us)
        message.pose.pose.position.y = 1e-3 * position_mm
        odometry.publish(message)
    # Before the scan begins: a sweep shorter than the scan is reported as incomplete.
    stamp = message.header.stamp
    wait_until(lambda: placed and placed[-1].transforms[-1].header.stamp == stamp, "the stage")
    speed = 1e-3 * abs(stage_speed_mm_s(recording))
    request = BeginScan.Request(scan_id="driver", start=0.0, stop=0.22, speed=speed)
    answer = observer.call(BeginScan, "reconstruction/begin_scan", request)
    assert answer.success, answer.message
    sent_ns = []
    for message in driver.packets(recording, zero_ns):
        events.publish(message)
        sent_ns.append(ns_from_stamp(message.header.stamp))
        if len(sent_ns) % AHEAD == 0:
            due_ns = sent_ns[-AHEAD]
            wait_until(
                lambda due_ns=due_ns: ns_from_stamp(states[-1].processed_until) >= due_ns,
                "progress",
            )
    # The last 50 ms are dark.
    last_ns = sent_ns[-1] - 20_000_000
    wait_until(lambda: ns_from_stamp(states[-1].processed_until) >= last_ns, "the last packets")
    camera.destroy_node()


@pytest.mark.parametrize("driver", [OURS, METAVISION], ids=lambda driver: driver.node)
def test_the_stream_of_each_driver_gives_the_points_of_the_recording(driver, recording, observer):
    parameters = {
        "frequency": recording.modulation.frequency_hz,
        "camera/events": Remap(driver.topic),
        "stage/odom": Remap("/my_stage/odom"),
        f"qos_overrides.{driver.topic}.subscription.reliability": driver.reliability,
    }
    with NodeProcess(
        "eschorty_ros.nodes.reconstruction.node", parameters, domain=observer.domain
    ) as node:
        states = observer.collect(ReconstructionState, "reconstruction/state", qos.stream())
        clouds = observer.collect(PointCloud2, "scan/points", qos.latched())
        wait_until(lambda: states, "the node's state")
        publish(driver, observer, recording, states)
        request = EndScan.Request(scan_id="driver")
        answer = observer.call(EndScan, "reconstruction/end_scan", request)
        assert answer.success, node.output
        assert (answer.packets_lost, answer.message) == (0, "")
        wait_until(lambda: clouds, "the cloud")
    points, expected = points_from_message(clouds[-1]), reconstruct_recording(recording).points
    assert len(points) == len(expected) > 20_000
    for name in ("x", "z", "intensity", "sigma", "column"):
        np.testing.assert_array_equal(points[name], expected[name], err_msg=name)
    assert np.abs(points["y"] - expected["y"]).max() < 1e-3 * SPEED_MM_S * CLOCK_S
