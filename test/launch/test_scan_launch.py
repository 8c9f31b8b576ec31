"""Runs the launch tests with ``launch_test`` wherever it is installed.

Not through launch_testing's pytest plugin: it coordinates no ROS domains and follows pytest's
releases late.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")
pytest.importorskip("launch_testing", reason="launch_testing is not installed")

TESTS = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize("name", ["scan", "calibration"])
def test_scenarios_under_launch(name):
    search = [str(TESTS), str(TESTS.parent), os.environ.get("PYTHONPATH", "")]
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "launch_testing.launch_test",
            str(TESTS / "launch" / f"{name}_scenarios_launch.py"),
        ],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(search)},
        capture_output=True,
        text=True,
        timeout=540.0,
        check=False,
    )
    print(done.stdout[-12_000:], done.stderr[-4_000:])
    assert done.returncode == 0
    assert "Ran 5 tests" in done.stdout + done.stderr
