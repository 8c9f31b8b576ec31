"""Live clouds: one message a profile, a bounded rate, spans that fit their times."""

from types import SimpleNamespace

import numpy as np
import pytest
from line_events import blank_profiles
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2

from eschorty_ros.core.optics import load_calibration
from eschorty_ros.core.reconstruction import place
from eschorty_ros.core.storage import POINT_DTYPE
from eschorty_ros.live.device_messages import ns_from_stamp
from eschorty_ros.live.scan_buffer import AssembledScan, PlacedPoints, ScanBuffer
from eschorty_ros.live.sensor_epoch import TimedProfiles
from eschorty_ros.nodes.reconstruction import outputs as outputs_module
from eschorty_ros.nodes.reconstruction.outputs import POINTS_INTERVAL_S, Outputs
from eschorty_ros.nodes.ros.cloud_messages import points_from_message
from eschorty_ros.nodes.ros.frames import frames

CALIBRATION = load_calibration("config_3")
ZERO_NS = 1_800_000_000_000_000_000
COLUMNS = 3
FRAMES = frames("left_")


class Publisher(list):
    def publish(self, message):
        serialized = isinstance(message, bytes)
        self.append(deserialize_message(message, PointCloud2) if serialized else message)

    def get_subscription_count(self):
        return 1


class Node:
    """Makes publishers that keep their messages, by topic."""

    def __init__(self):
        self.topics = {}

    def create_publisher(self, _type, topic, _qos, **_override):
        return self.topics.setdefault(topic, Publisher())


def timed(edges_us):
    """Return profiles of three columns, each event 10 us after the one before."""
    edge_us = np.repeat(np.array(edges_us, np.int64), COLUMNS)
    count = edge_us.size
    column = np.tile(np.arange(COLUMNS, dtype=np.uint16), len(edges_us))
    t_us = edge_us + 100 - 10 * column.astype(np.int64)
    profiles = blank_profiles(
        count, edge_us=edge_us, t_us=t_us, column=column, range_mm=1000.0 + np.arange(count)
    )
    times = ZERO_NS + t_us * 1000, ZERO_NS + edge_us * 1000
    return TimedProfiles(profiles, *times, CALIBRATION.model(), CALIBRATION.stage_direction)


def times_ns(message):
    since_ns = points_from_message(message)["t"].astype(np.int64)
    return (ns_from_stamp(message.header.stamp) + since_ns).tolist()


def test_every_profile_is_a_message_stamped_with_its_first_point():
    node = Node()
    outputs = Outputs(node, CALIBRATION, 1000.0, FRAMES)
    fresh = timed([0, 1000, 2000]), timed([3000])
    outputs.profiles(list(fresh))
    messages = node.topics["profile"]
    assert len(messages) == 4
    assert {message.header.frame_id for message in messages} == {"left_link"}
    for number, message in enumerate(messages):
        edge_ns = ZERO_NS + number * 1_000_000
        assert ns_from_stamp(message.header.stamp) == edge_ns + 80_000
        assert times_ns(message) == [edge_ns + 100_000, edge_ns + 90_000, edge_ns + 80_000]
        assert points_from_message(message)["column"].tolist() == [0, 1, 2]
    ranges_m = np.concatenate([points_from_message(message)["x"] for message in messages[:3]])
    np.testing.assert_allclose(ranges_m, fresh[0].profiles.range_mm * 1e-3, rtol=1e-6)


@pytest.mark.parametrize("pieces", [1, 4])
def test_the_rate_of_profiles_is_bounded(pieces):
    node = Node()
    outputs = Outputs(node, CALIBRATION, 250.0, FRAMES)
    for edges_us in np.split(np.arange(12) * 1000, pieces):
        outputs.profiles([timed(edges_us)])
    begins_ns = [ns_from_stamp(message.header.stamp) for message in node.topics["profile"]]
    assert np.diff(begins_ns).tolist() == [4_000_000, 4_000_000]


def test_points_further_apart_than_a_message_can_hold_are_in_two():
    node = Node()
    far = timed([0, 1000, 4_100_000, 8_300_000])
    points = place(far.profiles, CALIBRATION.model(), 0.0, CALIBRATION.stage_direction)
    Outputs(node, CALIBRATION, 1000.0, FRAMES).points(
        [PlacedPoints(points, far.t_ns, far.edge_ns, np.zeros(len(points)))]
    )
    messages = node.topics["points"]
    assert [message.width for message in messages] == [6, 3, 3]
    assert {message.header.frame_id for message in messages} == {"left_base"}
    assert [t for message in messages for t in times_ns(message)] == far.t_ns.tolist()


def test_points_wait_until_they_are_due(monkeypatch):
    now_s = [100.0]
    monkeypatch.setattr(outputs_module, "time", SimpleNamespace(monotonic=lambda: now_s[0]))
    node = Node()
    outputs = Outputs(node, CALIBRATION, 1000.0, FRAMES)
    near = timed([0])
    points = place(near.profiles, CALIBRATION.model(), 0.0, CALIBRATION.stage_direction)
    placed = PlacedPoints(points, near.t_ns, near.edge_ns, np.zeros(len(points)))
    outputs.points([placed])
    assert not outputs.waits
    outputs.points([placed])
    assert outputs.waits
    assert len(node.topics["points"]) == 1
    now_s[0] += 1.01 * POINTS_INTERVAL_S
    outputs.points([])
    assert not outputs.waits
    assert len(node.topics["points"]) == 2


def test_a_scan_without_points_leaves_the_cloud_before():
    node = Node()
    outputs = Outputs(node, CALIBRATION, 1000.0, FRAMES)
    outputs.scan(ScanBuffer("empty", 0.0, 100.0).assemble(), False)
    assert node.topics["scan/points"] == []
    points = np.zeros(4, POINT_DTYPE)
    outputs.scan(AssembledScan(points, np.zeros(4, np.int64), ZERO_NS, 1, 1e-3), False)
    assert [message.width for message in node.topics["scan/points"]] == [4]
