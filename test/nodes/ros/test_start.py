"""A node that cannot run as it is started, or beside one of its name, ends with one line."""

import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest
import rclpy
from ros_process import NodeProcess, Observer, domain_environment, wait_until

from eschorty_ros.hardware.base.launcher import VARIABLE
from eschorty_ros.nodes.laser.node import TABLE
from eschorty_ros.nodes.ros.domain import free_domain
from eschorty_ros.nodes.ros.parameters import Parameters
from eschorty_ros.nodes.ros.spin import run
from eschorty_ros.nodes.ros.unused import refuse_unused
from eschorty_ros.nodes.scanner.node import ScannerNode

LASER, SCANNER = "eschorty_ros.nodes.laser.node", "eschorty_ros.nodes.scanner.node"
IDLE = {"auto_start": False}
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
    [
        ("controller", "foo", "kbd101"),
        ("odom_rate", "fast", "100.0"),
        ("bay", 99, "bay"),
        ("frame_prefix", "/left_", "no slash"),
    ],
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
    node = [sys.executable, "-m", SCANNER]
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


def test_help_says_how_names_and_parameters_are_given_and_starts_nothing(capsys) -> None:
    assert run(ScannerNode, args=["--help"]) == 0
    output = capsys.readouterr().out
    assert output.startswith("Node ``scanner``: the ``scan`` action")
    assert "--ros-args -r __ns:=/eschorty -p NAME:=VALUE" in output
    assert not rclpy.ok()


@pytest.mark.parametrize("given", [["-p", "driver:=awg"], ["driver:=awg", "--ros-args"]])
def test_words_before_ros_args_are_refused(capsys, given: list[str]) -> None:
    assert run(ScannerNode, args=given) == 1
    assert f"{given[0]!r} is unknown" in capsys.readouterr().err
    assert not rclpy.ok()


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
    given = [argument.format(broken=broken) for argument in arguments]
    line = refusal(SCANNER, given, {**os.environ, **environment})
    assert words in line, line
    assert len(line) <= 300


def test_quality_of_service_of_no_topic_is_refused() -> None:
    name = "qos_overrides.{}/camera/events.subscription.reliability"
    with NodeProcess(
        "eschorty_ros.nodes.reconstruction.node",
        {name.format(""): "reliable"},
        domain=free_domain(),
    ) as process:
        assert process.wait() == 1
        line = process.output.splitlines()[-1]
    assert f"did you mean {name.format('/eschorty')}?" in line


def test_a_file_that_names_the_node_in_another_namespace_only_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "lab.yaml"
    file.write_text("/eschorty/laser: {ros__parameters: {high_max_v: 3.3}}")
    given = ["-r", "__ns:=/unit", "-p", "auto_start:=false", "--params-file", str(file)]
    line = refusal(LASER, given, domain_environment(free_domain()))
    assert "lab.yaml has parameters of /eschorty/laser and none of /unit/laser" in line


@pytest.mark.parametrize(
    "entries",
    [
        "/**: {ros__parameters: {high_max_v: 3.3}}",
        "/front/laser: {ros__parameters: {high_max_v: 3.3, of_another: 1}}",
        "{/eschorty/laser: {ros__parameters: {duty: 0.4}}, /unit/laser: {ros__parameters: {}}}",
    ],
)
def test_a_file_for_other_nodes_too_is_taken(tmp_path: Path, entries: str) -> None:
    file = tmp_path / "robot.yaml"
    file.write_text(entries)
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=free_domain())
    node = rclpy.create_node("laser", namespace="/unit", context=context)
    try:
        Parameters(node, TABLE)
        refuse_unused(node, ["--ros-args", "--params-file", str(file)])
    finally:
        node.destroy_node()
        context.shutdown()


def refusal(module: str, arguments: list[str], environment: Mapping[str, str]) -> str:
    """Return the one line with which a node ends at its start."""
    ended = subprocess.run(
        [sys.executable, "-m", module, "--ros-args", *arguments],
        env=environment,
        capture_output=True,
        text=True,
        timeout=60.0,
    )
    assert ended.returncode == 1
    (line,) = (ended.stdout + ended.stderr).strip().splitlines()
    return line


def assert_refused(second: NodeProcess, name: str) -> None:
    assert second.wait() == 1, second.output
    [line] = [line for line in second.output.splitlines() if line.strip()]
    assert line.startswith(f"error: another node /eschorty/{name} runs")
    assert len(line) <= 300


def test_the_second_refuses_and_after_a_kill_the_next_starts(observer: Observer) -> None:
    with NodeProcess(LASER, IDLE, domain=observer.domain) as first:
        observer.wait_for_state("laser", "unconfigured")
        with NodeProcess(LASER, IDLE, domain=observer.domain) as second:
            assert_refused(second, "laser")
        assert first.running()
        first.send(signal.SIGKILL)
        first.wait()
    # The killed node is still in the graph of the others.
    with NodeProcess(LASER, IDLE, domain=observer.domain) as third:
        observer.wait_for_state("laser", "unconfigured")
        assert third.running()


def test_of_two_started_together_one_runs(observer: Observer) -> None:
    with (
        NodeProcess(SCANNER, {}, domain=observer.domain) as one,
        NodeProcess(SCANNER, {}, domain=observer.domain) as other,
    ):
        wait_until(lambda: not (one.running() and other.running()), "the end of one")
        ended, alive = (one, other) if other.running() else (other, one)
        assert_refused(ended, "scanner")
        observer.wait_for_answers("scanner")
        assert alive.running()
