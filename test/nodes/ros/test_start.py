"""A node that cannot run as it is started ends with exit code 1 and one line."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from ros_process import NodeProcess, domain_environment, wait_until

from eschorty_ros.hardware.base.launcher import VARIABLE
from eschorty_ros.nodes.ros.domain import free_domain

NODES = ("camera", "laser", "stage", "reconstruction", "scanner", "replay")
# Starts a node and reports its process; the node is to end with it.
LAUNCHER = f"""
import os, subprocess, sys
environment = {{**os.environ, "{VARIABLE}": str(os.getpid())}}
print(subprocess.Popen(sys.argv[1:], env=environment, start_new_session=True).pid, flush=True)
sys.stdin.read()
"""


@pytest.mark.parametrize("node", NODES)
def test_an_unknown_parameter_is_refused_by_every_node(node: str) -> None:
    with NodeProcess(
        f"eschorty_ros.nodes.{node}.node", {"high_mx_v": 1.0}, domain=free_domain()
    ) as process:
        assert process.wait() == 1
        (line,) = process.output.splitlines()
    assert f"'high_mx_v' is no parameter of {node}" in line


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [("controller", "foo", "kbd101"), ("odom_rate", "fast", "100.0"), ("bay", 99, "bay")],
)
def test_a_value_that_is_refused_is_one_line(name: str, value: object, words: str) -> None:
    with NodeProcess(
        "eschorty_ros.nodes.stage.node", {name: value}, domain=free_domain()
    ) as process:
        assert process.wait() == 1
        (line,) = process.output.splitlines()
    assert name in line
    assert words in line


@pytest.mark.parametrize("early", [True, False])
def test_a_node_ends_when_its_launcher_is_killed(tmp_path: Path, early: bool) -> None:
    node = [sys.executable, "-m", "eschorty_ros.nodes.scanner.node"]
    log = tmp_path / "log"
    with log.open("wb") as stream:
        launcher = subprocess.Popen(
            [sys.executable, "-c", LAUNCHER, *node],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stream,
            env=domain_environment(free_domain()),
        )  # fmt: skip
    assert launcher.stdout is not None
    pid = int(launcher.stdout.readline())
    with os.fdopen(os.pidfd_open(pid)):
        if not early:
            wait_until(lambda: len(os.listdir(f"/proc/{pid}/task")) > 8, "a running node")
        launcher.send_signal(signal.SIGKILL)
        launcher.communicate()
        wait_until(lambda: not Path(f"/proc/{pid}").exists(), "the end of the node")
    assert log.read_text() == ""
