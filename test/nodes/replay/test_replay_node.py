"""A recording through the nodes gives the points it gives without ROS, bit for bit."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from ros_process import NodeProcess, Observer
from sensor_msgs.msg import PointCloud2
from waiting import DEADLINE_S, wait_until

from eschorty_ros.core.optics import load_calibration
from eschorty_ros.core.reconstruction import reconstruct_recording
from eschorty_ros.nodes.ros import qos
from eschorty_ros.nodes.ros.cloud_messages import points_from_message
from eschorty_ros.nodes.ros.domain import free_domain
from eschorty_ros.simulation.scenes import named
from eschorty_ros.simulation.world import simulate_recording

EVENTS = "qos_overrides./eschorty/camera/events.subscription.reliability"


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """20 mm of steps at 50 mm/s, seed 11."""
    return simulate_recording(
        tmp_path_factory.mktemp("replay") / "rec",
        named("steps"),
        load_calibration("config_3"),
        start_mm=40.0,
        stop_mm=60.0,
        seed=11,
    )


@pytest.mark.parametrize("rate", [0.0, 1.0])
def test_nodes_and_function_give_identical_points(recording, rate):
    expected = reconstruct_recording(recording).points
    assert len(expected) > 20_000
    domain = free_domain()
    parameters = {
        "calibration": recording.path / "calibration.yaml",
        "stage_gap": 0.0,
        EVENTS: "reliable",
    }
    with (
        NodeProcess(
            "eschorty_ros.nodes.reconstruction.node", parameters, domain=domain
        ) as reconstruction,
        NodeProcess(
            "eschorty_ros.nodes.replay.node",
            {"recording": recording.path, "rate": rate, "timeout": DEADLINE_S},
            domain=domain,
        ) as replay,
        Observer(domain) as observer,
    ):
        try:
            clouds = observer.collect(PointCloud2, "scan/points", qos.latched())
            assert replay.wait() == 0, replay.output
            wait_until(lambda: clouds, "scan/points")
            points = points_from_message(clouds[0])
        finally:
            print(reconstruction.output, replay.output)
    assert len(points) == len(expected)
    for name in ("x", "y", "z", "intensity", "sigma", "column"):
        np.testing.assert_array_equal(points[name], expected[name], err_msg=name)
    shift_s = points["t"] - expected["t"]
    assert np.ptp(shift_s) < 1e-9


def test_missing_recording_is_one_line(tmp_path):
    with NodeProcess(
        "eschorty_ros.nodes.replay.node", {"recording": tmp_path / "none"}, domain=free_domain()
    ) as replay:
        assert replay.wait() == 1
        lines = [line for line in replay.output.splitlines() if line.strip()]
        assert len(lines) == 1, replay.output
        assert "none" in lines[0]
