"""Launch files under launch, and the RViz view: it names only what exists."""

import fcntl
import os
import re
import signal
import subprocess
import sys
import xml.etree.ElementTree
from pathlib import Path

import pytest
import yaml
from waiting import wait_until

from eschorty_ros.nodes.ros.frames import FRAME_PREFIX, frames

ROOT = Path(__file__).resolve().parents[2]
LAUNCH = ROOT / "launch"
FILES = sorted(path.name for path in LAUNCH.glob("*.py"))
FRAMES = {"eschorty_base", "eschorty_stage", "eschorty_link", "eschorty_optical"}
# Topic -> durability its publisher offers.
CLOUDS = {
    "/eschorty/scan/points": "Transient Local",
    "/eschorty/points": "Volatile",
    "/eschorty/profile": "Volatile",
}
# As `ros2 launch FILE ARGUMENTS` does it.
COMMAND = """
import sys
from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
file, *given = sys.argv[1:]
service = LaunchService(argv=given)
source = PythonLaunchDescriptionSource(file)
pairs = [tuple(text.split(":=", 1)) for text in given]
included = IncludeLaunchDescription(source, launch_arguments=pairs)
service.include_launch_description(LaunchDescription([included]))
sys.exit(service.run())
"""


@pytest.fixture
def launched(tmp_path):
    """Run a launch file; gives its process and a function that returns its output."""
    pytest.importorskip("launch_ros", reason="launch_ros is not installed")
    from eschorty_ros.nodes.ros.domain import free_domain

    started = []

    def start(file, *given, domain=None):
        log = tmp_path / f"{len(started)}.log"
        with log.open("wb") as stream:
            process = subprocess.Popen(
                [sys.executable, "-c", COMMAND, str(LAUNCH / file), *given],
                stdout=stream, stderr=stream, start_new_session=True,
                env={**os.environ, "ROS_DOMAIN_ID": domain or str(free_domain()),
                     "ROS_LOG_DIR": str(tmp_path), "XDG_RUNTIME_DIR": str(tmp_path)},
            )  # fmt: skip
        started.append(process)
        return process, lambda: log.read_text(errors="replace")

    yield start
    for process in started:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
            process.wait(30.0)


def pids(output):
    return [int(pid) for pid in re.findall(r"process started with pid \[(\d+)\]", output)]


def running(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.parametrize("file", FILES)
def test_a_bad_argument_ends_the_launch_before_any_node(launched, file):
    for given in ("parameters:=/nope.yaml", "parametres:=a"):
        process, output = launched(file, given, "recording:=/nope")
        assert process.wait(60.0) == 1, output()
        assert given.partition(":=")[0] in output().splitlines()[-1]
        assert not pids(output())
        assert "Traceback" not in output()


def test_a_process_that_refuses_to_run_ends_the_launch(launched, tmp_path):
    from eschorty_ros.nodes.ros.domain import free_domain

    domain = str(free_domain())
    folder = tmp_path / f"eschorty-bench-{domain}"
    folder.mkdir(mode=0o700)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        process, output = launched("calibrate.launch.py", domain=domain)
        assert process.wait(120.0) == 1, output()
    assert "another bench uses it" in output()
    assert "bench-1 ended with exit code 1" in output()
    assert not any(map(running, pids(output())))


def test_nodes_end_when_their_launcher_is_killed(launched):
    process, output = launched("scan.launch.py", "auto_scan:=false")
    wait_until(lambda: len(pids(output())) == 6, "six processes")
    process.kill()
    wait_until(lambda: not any(map(running, pids(output()))), "the end of all of them")


def test_the_launch_ends_with_an_error_after_a_node_was_killed(launched):
    process, output = launched("scan.launch.py", "auto_scan:=false")
    wait_until(lambda: len(pids(output())) == 6, "six processes")
    os.kill(pids(output())[0], signal.SIGKILL)
    wait_until(lambda: "was killed by signal 9" in output(), "its line")
    process.send_signal(signal.SIGINT)
    assert process.wait(30.0) == 1, output()


PUSHED = """
from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch_ros.actions import PushRosNamespace
def generate_launch_description():
    scan = IncludeLaunchDescription(
        PythonLaunchDescriptionSource({file!r}),
        launch_arguments=[("auto_scan", "false"), ("parameters", {parameters!r})],
    )
    return LaunchDescription([PushRosNamespace("robot"), scan])
"""


def test_nodes_in_a_pushed_namespace_take_the_parameter_file(launched, tmp_path):
    parameters, including = tmp_path / "lab.yaml", tmp_path / "robot.launch.py"
    parameters.write_text("/eschorty/reconstruction: {ros__parameters: {trigger_source: none}}")
    file = str(LAUNCH / "scan.launch.py")
    including.write_text(PUSHED.format(file=file, parameters=str(parameters)))
    _, output = launched(including)
    wait_until(lambda: "trigger source" in output(), "the reconstruction's line")
    assert "trigger source none, events /robot/eschorty/camera/events" in output()


def test_rviz_shows_our_topics_with_our_quality_of_service():
    view = yaml.safe_load((ROOT / "config" / "scan.rviz").read_text())["Visualization Manager"]
    assert view["Global Options"]["Fixed Frame"] == "eschorty_base"
    topics = [display["Topic"] for display in view["Displays"] if "Topic" in display]
    assert {topic["Value"]: topic["Durability Policy"] for topic in topics} == CLOUDS
    assert {topic["Reliability Policy"] for topic in topics} == {"Reliable"}
    assert any(display["Class"].endswith("/TF") for display in view["Displays"])


def test_rviz_names_frames_that_are_published():
    text = (ROOT / "config" / "scan.rviz").read_text()
    named = set(re.findall(r"\beschorty_\w+", text))
    assert named <= FRAMES == set(frames(FRAME_PREFIX.default))


def test_dds_profile_repeats_lost_messages_soon_and_shares_no_memory():
    space = {"d": "http://www.eprosima.com"}
    root = xml.etree.ElementTree.parse(ROOT / "config" / "fastdds.xml").getroot()
    assert root.find(".//d:participant", space).get("is_default_profile") == "true"
    assert root.find(".//d:useBuiltinTransports", space).text == "false"
    types = {node.text for node in root.findall(".//d:transport_descriptor/d:type", space)}
    assert types == {"UDPv4"}
    writer = root.find(".//d:data_writer", space)
    assert writer.get("is_default_profile") == "true"
    assert int(writer.find(".//d:nanosec", space).text) <= 200_000_000
