"""Times, units and clouds across the message border."""

from array import array

import numpy as np
import pytest
from eschorty_ros.msg import LaserState
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.reconstruction import LIVE_DTYPE, live_points
from eschorty_ros.core.storage import POINT_DTYPE, REFLECTANCE_DTYPE
from eschorty_ros.live.device_messages import laser_settings, ns_from_stamp
from eschorty_ros.nodes.ros import transforms
from eschorty_ros.nodes.ros.cloud_messages import (
    cloud_message,
    image_message,
    points_from_message,
    serialized_cloud,
)
from eschorty_ros.nodes.ros.conversions import stamp_from_ns
from eschorty_ros.nodes.ros.frames import frames


@settings(derandomize=True, deadline=None)
@given(st.integers(-(2**31) * 10**9, (2**31) * 10**9 - 1))
def test_stamps_are_exact(t_ns):
    assert ns_from_stamp(stamp_from_ns(t_ns)) == t_ns


def random_points(count):
    rng = np.random.default_rng(5)
    points = np.zeros(count, POINT_DTYPE)
    for name in POINT_DTYPE.names:
        points[name] = rng.uniform(0, 1000, count)
    return points


@pytest.mark.parametrize("count", [0, 1, 1280])
def test_scan_cloud_keeps_every_bit(count):
    points = random_points(count)
    message = cloud_message(points, 12_345_678_901_234_567_890 // 10, "eschorty_base")
    assert type(message.data) is array
    assert ns_from_stamp(message.header.stamp) == 1_234_567_890_123_456_789
    assert message.row_step == len(message.data) == message.point_step * count
    np.testing.assert_array_equal(points_from_message(message), points)


def test_live_cloud_counts_ns_from_its_stamp():
    points = random_points(4)
    t_ns = 10**18 + np.array([0, 1, 3_999_999_999, 7])
    live = live_points(points, t_ns, 10**18)
    message = cloud_message(live, 10**18, "eschorty_link")
    seen = points_from_message(message)
    assert seen.dtype.names == LIVE_DTYPE.names
    assert seen["t"].tolist() == [0, 1, 3_999_999_999, 7]
    np.testing.assert_array_equal(seen["x"], points["x"])
    assert [(f.name, f.offset) for f in message.fields[:3]] == [("x", 0), ("y", 4), ("z", 8)]


@pytest.mark.parametrize("frame_id", ["a", "ab", "abc", "abcd", "eschorty_link"])
@pytest.mark.parametrize("dtype", [LIVE_DTYPE, POINT_DTYPE, REFLECTANCE_DTYPE])
def test_a_serialized_cloud_is_that_of_all_parts(frame_id, dtype):
    points = np.frombuffer(np.random.default_rng(5).bytes(9 * dtype.itemsize), dtype)
    for ends in ([], [4], [0, 9]):
        parts = np.split(points, ends)
        serialized = serialized_cloud(parts, 10**18 + 7, frame_id)
        message = deserialize_message(serialized, PointCloud2)
        assert message == cloud_message(points, 10**18 + 7, frame_id)


def test_reflectance_goes_along_when_the_points_have_it():
    points = np.zeros(3, REFLECTANCE_DTYPE)
    points["reflectance"] = [0.25, 0.5, 1.0]
    live = live_points(points, 10**18 + np.arange(3), 10**18)
    for cloud in (points, live):
        seen = points_from_message(cloud_message(cloud, 10**18, "eschorty_link"))
        assert seen.dtype.names[-2:] == ("reflectance", "reflectance_sigma")
        np.testing.assert_array_equal(seen["reflectance"], points["reflectance"])
    assert live["t"].dtype == np.uint32


def test_image_is_row_major():
    pixels = np.arange(6, dtype=np.uint8).reshape(2, 3)
    message = image_message(pixels, 0, "eschorty_optical")
    assert (message.height, message.width, message.step) == (2, 3, 3)
    assert message.data.tolist() == [0, 1, 2, 3, 4, 5]


def test_laser_state_without_epoch_leaves_the_phase_unknown():
    state = LaserState(frequency=70.0, duty=0.5, waveform="square")
    assert laser_settings(state).epoch_ns is None
    state.phase_epoch = stamp_from_ns(10**18 + 1)
    laser = laser_settings(state)
    assert (laser.modulation.frequency_hz, laser.epoch_ns) == (70.0, 10**18 + 1)
    with pytest.raises(ArgumentError, match=r"^frequency is 0"):
        laser_settings(LaserState(duty=0.5, waveform="square"))


def test_optical_frame_is_a_rotation_with_z_along_the_range_axis():
    _, optical = transforms.mounts(frames("left_"), 0)
    q = optical.transform.rotation
    rotation = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    assert np.isclose(np.linalg.norm([q.x, q.y, q.z, q.w]), 1.0)
    # Columns are the optical axes in the link frame: x along the line, z along the range.
    np.testing.assert_allclose(rotation[:, 0], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(rotation[:, 2], [1, 0, 0], atol=1e-12)


def test_carriage_moves_along_the_stage_direction():
    carriage = transforms.carriage(frames("left_"), 5, 100.0, (0.0, 0.8, 0.6))
    assert (carriage.header.frame_id, carriage.child_frame_id) == ("left_base", "left_stage")
    moved = carriage.transform.translation
    np.testing.assert_allclose([moved.x, moved.y, moved.z], [0.0, 0.08, 0.06])
