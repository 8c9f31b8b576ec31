"""A node that ROS cannot start ends with exit code 1 and one line."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")


@pytest.mark.parametrize(
    ("arguments", "environment", "words"),
    [
        (("--params-file", "/none.yaml"), {}, "/none.yaml"),
        (("--params-file", "{broken}"), {}, "broken.yaml"),
        (("-r", "bad::="), {}, "bad::="),
        ((), {"ROS_SECURITY_ENABLE": "true", "ROS_SECURITY_STRATEGY": "Enforce"}, "KEYSTORE"),
    ],
)
def test_ros_that_does_not_start_is_one_line(tmp_path: Path, arguments, environment, words) -> None:
    broken = tmp_path / "broken.yaml"
    broken.write_text("a: [1")
    ended = subprocess.run(
        [sys.executable, "-m", "eschorty_ros.nodes.scanner.node", "--ros-args",
         *(argument.format(broken=broken) for argument in arguments)],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=60.0,
    )  # fmt: skip
    assert ended.returncode == 1
    (line,) = (ended.stdout + ended.stderr).strip().splitlines()
    assert words in line, line
    assert len(line) <= 300
