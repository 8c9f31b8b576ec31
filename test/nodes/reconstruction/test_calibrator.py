"""The end of a calibration whose reconstruction answers too late."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from eschorty_ros.action import Calibrate
from eschorty_ros.msg import CalibrationTarget
from rclpy.node import Node
from reconstructing import CALIBRATION
from ros_process import Observer, nodes_here, wait_until

from eschorty_ros.nodes.reconstruction.active_calibration import ActiveCalibration
from eschorty_ros.nodes.reconstruction.calibrator import Calibrator


class Reconstruction(Node):
    """A calibrator whose worker does not begin a job in time when it is to end a capture."""

    def __init__(self, folder: Path, **kwargs: Any) -> None:
        super().__init__("reconstruction", **kwargs)
        self.captures: list[Any] = []
        active = ActiveCalibration(self, CALIBRATION, "", str(folder), False, lambda _: None)
        self._calibrator = Calibrator(
            self, active, self._in_worker, self.captures.append, lambda: 4.0, "optical",
            (0.1, 0.1, 0.1),
        )  # fmt: skip

    def _in_worker(self, job: Callable[[], None], timeout_s: float) -> tuple[bool, str]:
        if self.captures and timeout_s:
            return False, "no answer in time"
        job()
        return True, ""

    def safe_state(self) -> None:
        self._calibrator.safe_state()


def test_a_capture_ends_also_when_the_worker_is_late(observer: Observer, tmp_path: Path) -> None:
    targets = [CalibrationTarget(range=range_m, column=-1.0, row=-1.0) for range_m in (0.9, 1.2)]
    with nodes_here(observer.domain, 4) as start:
        node = start(lambda **kwargs: Reconstruction(tmp_path, **kwargs))
        client = observer.action_client(Calibrate, "calibrate")
        wait_until(client.server_is_ready, "the action")
        sent = client.send_goal_async(Calibrate.Goal(targets=targets, capture_time=1.0))
        wait_until(sent.done, "the goal's acceptance")
        ended = sent.result().get_result_async()
        wait_until(ended.done, "the result")
        client.destroy()
        assert not ended.result().result.success
        assert node.captures[0] is not None
        assert node.captures[1:] == [None]
