"""Runs the launch test with ``launch_test`` wherever it is installed.

Not through launch_testing's pytest plugin: it coordinates no ROS domains and follows pytest's
releases late.
"""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")
pytest.importorskip("launch_testing", reason="launch_testing is not installed")

TESTS = Path(__file__).resolve().parents[1]
SCENARIOS = str(TESTS / "launch" / "scan_scenarios_launch.py")


def test_scenarios_under_launch(tmp_path):
    search = [str(TESTS / "support"), str(TESTS.parent), os.environ.get("PYTHONPATH", "")]
    log_path = tmp_path / "launch.log"
    with (
        log_path.open("w") as log,
        subprocess.Popen(
            [sys.executable, "-m", "launch_testing.launch_test", SCENARIOS],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(search)},
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        ) as process,
    ):
        try:
            process.wait(540.0)
        finally:
            end_group(process)
            print(log_path.read_text(errors="replace")[-16_000:])
    assert process.returncode == 0
    assert log_path.read_text(errors="replace").count("Ran 2 tests") == 2


def end_group(process):
    """End what the command has left running, and the command itself when it is late.

    A killed node would leave its shared memory.
    """
    with contextlib.suppress(ProcessLookupError):
        for number in (signal.SIGTERM, signal.SIGKILL):
            os.killpg(process.pid, number)
            end_s = time.monotonic() + 20.0
            while time.monotonic() < end_s:
                process.poll()
                os.killpg(process.pid, 0)
                time.sleep(0.1)
