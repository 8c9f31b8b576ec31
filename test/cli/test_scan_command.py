"""`eschorty scan` over real DDS: cloud, picture, figures, and a dark laser however it ends."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from expected_scan import assert_accurate

from eschorty_ros.cli import INTERRUPTED
from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.core.storage import POINT_DTYPE, read_cloud
from eschorty_ros.report.accuracy import Sweep

pytest.importorskip("rclpy", reason="rclpy is not installed")

ROOT = Path(__file__).resolve().parents[2]
DEADLINE_S = 300
LOGGED = """
import sys
from eschorty_ros.nodes.one_process import scan as one_scan
made = one_scan.bench_options
log = sys.argv.pop(1)
one_scan.bench_options = lambda *values: made(*values) | {"laser-log": log}
from eschorty_ros.cli import main
main(prog_name="eschorty")
"""


@pytest.fixture
def command(tmp_path):
    """Starts `eschorty scan` as a process; the emulated generator logs to `laser.log`."""
    started = []
    environment = {key: value for key, value in os.environ.items() if key != "ROS_DOMAIN_ID"}

    def start(*arguments):
        process = subprocess.Popen(
            [sys.executable, "-c", LOGGED, tmp_path / "laser.log", "scan", *map(str, arguments)],
            cwd=ROOT,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            # As a shell starts its background jobs: the signal must end the scan even so.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),
        )
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


def outputs(log):
    """States in the emulated generator's log, in order."""
    return re.findall(r"\b(on|off)\b", log.read_text().lower()) if log.exists() else []


def test_a_scan_reaches_its_accuracy_and_ends_dark(command, tmp_path):
    process = command("--stop", 40, "--out", tmp_path / "scan")
    stdout, stderr = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 0, stderr
    points = read_cloud(tmp_path / "scan" / "scan.pcd")
    measured = assert_accurate(points, Sweep(10.0, 40.0, 50.0, 70.0))
    assert f"{measured.error_median_mm:.3f} mm" in stdout
    assert f"{measured.error_p95_mm:.3f} mm" in stdout
    assert (tmp_path / "scan" / "scan.png").read_bytes().startswith(b"\x89PNG")
    assert outputs(tmp_path / "laser.log")[-1] == "off"
    assert "on" in outputs(tmp_path / "laser.log")


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, INTERRUPTED), (signal.SIGTERM, 128 + signal.SIGTERM)]
)
def test_a_signal_ends_the_scan_dark_without_a_traceback(command, tmp_path, number, code):
    process = command("--speed", 2, "--out", tmp_path / "scan")
    deadline = time.monotonic() + DEADLINE_S
    while "on" not in outputs(tmp_path / "laser.log"):
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < deadline
        time.sleep(0.05)
    process.send_signal(number)
    _, stderr = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == code, stderr
    assert "Traceback" not in stderr
    assert outputs(tmp_path / "laser.log")[-1] == "off"


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("--stop", "900"), "stop"),
        (("--speed", "5000"), "speed"),
        (("--scene", "teapot"), "teapot"),
        (("--calibration", "config_9"), "config_9"),
    ],
)
def test_what_cannot_be_done_is_one_line_and_exit_code_1(command, tmp_path, arguments, named):
    process = command(*arguments, "--out", tmp_path / "scan")
    stdout, stderr = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 1, stderr
    assert stdout == ""
    said = [line for line in stderr.splitlines() if line.startswith("eschorty: ")]
    assert len(said) == 1
    assert named in said[0]
    assert "Traceback" not in stderr
    assert "on" not in outputs(tmp_path / "laser.log")


def test_without_ros_it_says_what_to_do():
    blocked = """
import sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == "rclpy":
            raise ImportError("No module named 'rclpy'")
sys.meta_path.insert(0, Blocked())
from eschorty_ros.cli import main
main(prog_name="eschorty")
"""
    done = subprocess.run(
        [sys.executable, "-c", blocked, "scan"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
    )
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "make scan" in done.stderr


def test_a_scan_without_points_is_no_success(tmp_path):
    from eschorty_ros.cli.scan import finish
    from eschorty_ros.nodes.one_process.scan import ScanJob, ScanResult

    request = ScanJob("leaves", "config_3", 0.0, 20.0, 100.0, 70.0, 0, "paper")
    points = np.empty(0, POINT_DTYPE)
    with pytest.raises(DeviceError, match="no points: no events came"):
        finish(request, ScanResult(True, "no points: no events came", points, 0, 0, 0, 0), tmp_path)
    assert len(read_cloud(tmp_path / "scan.pcd")) == 0


def test_what_a_scan_lost_is_printed(tmp_path, capsys):
    from eschorty_ros.cli.scan import finish
    from eschorty_ros.nodes.one_process.scan import ScanJob, ScanResult

    request = ScanJob("leaves", "config_3", 0.0, 20.0, 100.0, 70.0, 0, "paper", hardware={})
    points = np.zeros(4, POINT_DTYPE)
    points["x"] = points["t"] = points["y"] = points["column"] = [1, 2, 3, 4]
    lost = "7 points had no stage position"
    finish(request, ScanResult(True, lost, points, 4, 100, 0, 0), tmp_path)
    assert lost in capsys.readouterr().out
