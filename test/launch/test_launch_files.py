"""Launch files and RViz view: they parse, and name only what exists."""

import ast
import importlib.util
import re
import xml.etree.ElementTree
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
LAUNCH = ROOT / "launch"
SHARED = ast.parse((ROOT / "eschorty_ros" / "nodes" / "ros" / "launching.py").read_text()).body
ROWS = {node.target.id: node.value for node in SHARED if isinstance(node, ast.AnnAssign)}
FUNCTIONS = {node.name: node for node in SHARED if isinstance(node, ast.FunctionDef)}
NODES = {"camera", "laser", "stage", "reconstruction", "scanner", "replay"}
FRAMES = {"eschorty_base", "eschorty_stage", "eschorty_link", "eschorty_optical"}
# Topic -> durability its publisher offers.
CLOUDS = {
    "/eschorty/scan/points": "Transient Local",
    "/eschorty/points": "Volatile",
    "/eschorty/profile": "Volatile",
}
STARTED = {
    "scan.launch.py": NODES - {"replay"},
    "calibrate.launch.py": NODES - {"replay", "scanner"},
    "replay.launch.py": {"reconstruction", "replay"},
}
EXPECTED = {
    "scan.launch.py": "fake parameters trigger scene pixels calibration frequency speed start stop"
    " rviz auto_scan",
    "calibrate.launch.py": "fake parameters trigger scene pixels calibration as_built frequency"
    " distances method capture_time calibration_folder auto_calibrate",
    "replay.launch.py": "recording rate parameters rviz",
}


def declared(tree):
    """Names and descriptions in the file's ARGUMENTS table."""
    for node in tree.body:
        if isinstance(node, ast.Assign) and node.targets[0].id == "ARGUMENTS":
            rows = [ROWS[row.id] if isinstance(row, ast.Name) else row for row in node.value.elts]
            return {row.elts[0].value: ast.unparse(row.elts[2]) for row in rows}
    raise AssertionError("no ARGUMENTS table")


def configurations(tree):
    """Every argument name the file reads, also by what it calls in `launching`."""
    used = set()
    for node in ast.walk(tree):
        if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Name)):
            continue
        name = node.func.id
        if name in ("LaunchConfiguration", "number", "text", "boolean"):
            used |= {value.value for value in node.args if isinstance(value, ast.Constant)}
        elif name in FUNCTIONS:
            used |= configurations(FUNCTIONS[name])
        if name == "bench":
            used |= {keyword.value.value for keyword in node.keywords}
    return used


@pytest.mark.parametrize("name", EXPECTED)
def test_every_argument_is_declared_described_and_used(name):
    tree = ast.parse((LAUNCH / name).read_text())
    compile(tree, name, "exec")
    arguments = declared(tree)
    assert set(arguments) == configurations(tree) == set(EXPECTED[name].split())
    assert all(len(description) > 15 for description in arguments.values())


@pytest.mark.parametrize("name", EXPECTED)
def test_launch_files_use_only_what_launch_ros_0_28_has(name):
    text = (LAUNCH / name).read_text()
    assert "autostart" not in text
    assert "LifecycleNode" not in text


def test_every_node_a_launch_file_starts_is_a_module():
    for name in NODES:
        assert (ROOT / "eschorty_ros" / "nodes" / name / "node.py").is_file()


@pytest.mark.parametrize("name", EXPECTED)
def test_launch_loads_the_description(name):
    pytest.importorskip("launch", reason="launch is not installed")
    pytest.importorskip("launch_ros", reason="launch_ros is not installed")
    from launch.actions import DeclareLaunchArgument
    from launch_ros.actions import Node

    from launch import LaunchContext

    spec = importlib.util.spec_from_file_location("described", LAUNCH / name)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    entities = module.generate_launch_description().entities
    context = LaunchContext()
    context.launch_configurations["recording"] = "/tmp"
    for argument in filter(lambda entity: isinstance(entity, DeclareLaunchArgument), entities):
        argument.execute(context)
    nodes = [entity for entity in entities if isinstance(entity, Node)]
    started = [n for n in nodes if n.condition is None or n.condition.evaluate(context)]
    assert {node.node_executable for node in started} == STARTED[name]


def test_rviz_shows_our_topics_with_our_quality_of_service():
    view = yaml.safe_load((ROOT / "config" / "scan.rviz").read_text())["Visualization Manager"]
    assert view["Global Options"]["Fixed Frame"] == "eschorty_base"
    topics = [display["Topic"] for display in view["Displays"] if "Topic" in display]
    assert {topic["Value"]: topic["Durability Policy"] for topic in topics} == CLOUDS
    assert {topic["Reliability Policy"] for topic in topics} == {"Reliable"}
    assert any(display["Class"].endswith("/TF") for display in view["Displays"])


def test_rviz_names_frames_that_are_published():
    text = (ROOT / "config" / "scan.rviz").read_text()
    published = (ROOT / "eschorty_ros" / "nodes" / "ros" / "transforms.py").read_text()
    named = set(re.findall(r"\beschorty_\w+", text))
    assert named <= FRAMES
    assert all(f'"{frame}"' in published for frame in named)


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
