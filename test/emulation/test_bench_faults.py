"""A fault plan on a whole bench: what the cables' near ends see of it."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from waiting import wait_until

from eschorty_ros.core.errors import DeviceError
from eschorty_ros.emulation.bench_folder import STAGE_PORT, usb_spec
from eschorty_ros.emulation.bench_process import bench_process
from eschorty_ros.hardware.camera.evk4 import Evk4
from eschorty_ros.hardware.usb import open_backend


@pytest.fixture
def folder() -> Iterator[Path]:
    """Short, because a Unix socket's path is limited."""
    with tempfile.TemporaryDirectory(prefix="bench_") as name:
        yield Path(name) / "bench"


def planned(path: Path, text: str) -> dict[str, object]:
    path.write_text(text)
    return {"scene": "plane", "fault-plan": path}


def test_devices_go_and_come_back_as_planned(folder: Path, tmp_path: Path) -> None:
    plan = """
    faults:
      - {device: laser, fault: unplug, at: {after_s: 0.5}, for_s: 5.0}
      - {device: stage, fault: unplug, at: {after_s: 0.5}, for_s: 5.0}
    """
    with bench_process(folder, planned(tmp_path / "plan.yaml", plan)):
        bus = open_backend(usb_spec(folder))
        port = folder / STAGE_PORT

        def seen() -> tuple[int, bool]:
            return len(list(bus.enumerate_devices())), port.exists()

        wait_until(lambda: seen() == (1, False), "laser and stage gone")
        wait_until(lambda: seen() == (2, True), "laser and stage back")


def test_the_camera_comes_back_after_a_planned_unplug(folder: Path, tmp_path: Path) -> None:
    plan = "faults: [{device: camera, fault: unplug, at: {after_bytes: 200000}, for_s: 0.2}]"
    with bench_process(folder, planned(tmp_path / "plan.yaml", plan)):
        camera = Evk4(open_backend(usb_spec(folder)), time.monotonic_ns)
        restarts: list[bool] = []

        def began_again() -> bool:
            chunk = camera.read(0.1)
            if chunk is not None:
                restarts.append(chunk.restarted)
            return sum(restarts) == 2

        try:
            camera.open()
            camera.start()
            wait_until(began_again, "the stream's second beginning")
            statistics = camera.statistics()
        finally:
            camera.close()
        assert restarts[0]
        assert (statistics["losses"], statistics["reconnects"]) == (1, 1)


def test_a_plan_that_cannot_be_followed_ends_the_bench_in_one_line(
    folder: Path, tmp_path: Path
) -> None:
    options = planned(tmp_path / "plan.yaml", "faults: [{device: camera, fault: x, at: {}}]")
    with (
        pytest.raises(DeviceError, match=r"plan\.yaml") as refused,
        bench_process(folder, options),
    ):
        pass
    assert "\n" not in str(refused.value)
