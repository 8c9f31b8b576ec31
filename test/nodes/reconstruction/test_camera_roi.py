"""The camera's region of interest follows the one that is reconstructed."""

import time
from dataclasses import replace
from typing import Any

import pytest
from eschorty_ros.srv import LoadCalibration
from rclpy.node import Node
from reconstructing import CALIBRATION
from ros_process import nodes_here
from waiting import wait_until

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.optics import save_named_calibration
from eschorty_ros.core.reconstruction import Settings, region_window
from eschorty_ros.nodes.reconstruction.camera_roi import CameraRoi
from eschorty_ros.nodes.reconstruction.node import ReconstructionNode

MODEL = CALIBRATION.model()
FULL = [0, 0, MODEL.columns, MODEL.rows]
PART = Settings(column_first=100, column_last=299)


class Camera(Node):
    """A camera node's name and parameter."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("camera", **kwargs)
        self.declare_parameter("roi", FULL)

    def roi(self) -> list[int]:
        return list(self.get_parameter("roi").value)

    def safe_state(self) -> None:
        pass


class OtherCamera(Camera):
    """One without that parameter."""

    def declare_parameter(self, name: str, *args: Any, **kwargs: Any) -> Any:
        return super().declare_parameter("other" if name == "roi" else name, *args, **kwargs)


class Reconstruction(Node):
    def __init__(self, **kwargs: Any) -> None:
        super().__init__("reconstruction", **kwargs)

    def safe_state(self) -> None:
        pass


def followed(start: Any, follows: bool) -> CameraRoi:
    roi = CameraRoi(start(Reconstruction), follows)
    roi.follow(PART, MODEL)
    return roi


def test_the_camera_gets_the_window_of_the_region_also_when_it_starts_later(observer):
    with nodes_here(observer.domain, 2) as start:
        roi = followed(start, True)
        camera = start(Camera)
        wait_until(lambda: camera.roi() == [100, 0, 200, MODEL.rows], "the window")
        with pytest.raises(ArgumentError, match="calibrate without limits"):
            roi.check_full()
        roi.follow(Settings(), MODEL)
        wait_until(lambda: camera.roi() == FULL, "the full sensor")
        roi.check_full()


def test_a_camera_that_is_to_be_left_alone_is(observer):
    with nodes_here(observer.domain, 2) as start:
        camera = start(Camera)
        roi = followed(start, False)
        assert observer.set_parameter("camera", "roi", [0, 0, 8, 8])[0]
        # Time for some requests, if there were any.
        time.sleep(1.0)
        assert camera.roi() == [0, 0, 8, 8]
        roi.check_full()


def test_a_calibration_exchanged_while_the_settings_change_gives_the_window_of_both(
    observer, monkeypatch, tmp_path
):
    other = replace(CALIBRATION, b_prime_px=CALIBRATION.b_prime_px + 20.0)
    save_named_calibration(tmp_path, other, "other")
    follow, loading = CameraRoi.follow, []

    def slow_follow(roi: CameraRoi, settings: Settings, model: Any) -> None:
        if settings.range_max and not loading:
            loading.append(load.call_async(LoadCalibration.Request(calibration="other")))
            # It ends here unless it waits, as it should, for the end of this change.
            end_s = time.monotonic() + 1.0
            while not loading[0].done() and time.monotonic() < end_s:
                time.sleep(0.01)
        follow(roi, settings, model)

    monkeypatch.setattr(CameraRoi, "follow", slow_follow)
    given = {"calibration_folder": str(tmp_path), "camera_roi": "follow", "frequency": 70.0}
    with nodes_here(observer.domain, 4) as start:
        start(ReconstructionNode, **given)
        camera = start(Camera)
        load = observer.node.create_client(LoadCalibration, "reconstruction/load_calibration")
        wait_until(load.service_is_ready, "the service")
        assert observer.set_parameter("reconstruction", "range_max", 1.2)[0]
        wait_until(lambda: loading and loading[0].done(), "the exchange")
        assert loading[0].result().success
        window = region_window(Settings(range_max=1.2), other.model())
        assert window != region_window(Settings(range_max=1.2), MODEL)
        wait_until(lambda: camera.roi() == list(window), "the window")


def test_a_camera_that_refuses_is_reported(observer, capfd):
    with nodes_here(observer.domain, 2) as start:
        start(OtherCamera)
        followed(start, True)
        seen: list[str] = []
        wait_until(
            lambda: seen.append(capfd.readouterr().err) or "refuses roi" in "".join(seen),
            "the warning",
        )
