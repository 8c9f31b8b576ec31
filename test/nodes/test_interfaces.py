"""docs/interfaces.md describes every topic, service, action and parameter of the nodes."""

from collections.abc import Iterator
from fnmatch import fnmatch
from xml.etree import ElementTree

import interfaces as tables
import policies
import pytest
from eschorty_ros.action import Scan
from rclpy.action import ActionClient
from rclpy.node import Node

from eschorty_ros.nodes.ros.instrument_client import InstrumentClient


@pytest.fixture(scope="module")
def nodes() -> Iterator[list[Node]]:
    with tables.every_node() as made:
        yield made


@pytest.fixture(scope="module")
def page() -> str:
    return tables.PAGE.read_text(encoding="utf-8")


def test_the_page_has_the_topics(nodes, page):
    assert tables.topic_table(nodes) in page, "run: make reference"


def test_the_page_has_the_services_and_actions(nodes, page):
    assert tables.service_table(nodes) in page, "run: make reference"


def test_the_page_has_every_parameter_with_default_and_range(page):
    assert tables.parameter_tables() in page, "run: make reference"


def test_the_described_names_are_those_of_the_nodes(nodes):
    assert set(tables.topics(nodes)) == set(tables.TOPICS)
    assert set(tables.services(nodes)) == set(tables.SERVICES)


def test_the_parameter_tables_are_what_the_nodes_declare(nodes):
    for node in nodes:
        described = {param.name for param in tables.PARAMETERS[node.get_name()]}
        declared = {name for name in node._parameters if not name.startswith("qos_overrides.")}
        assert declared - {"use_sim_time", "start_type_description_service"} == described


def test_the_policies_of_sros2_allow_what_the_nodes_do_and_no_more(nodes):
    made = policies.policies(nodes)
    assert {path.name for path in policies.FOLDER.iterdir()} == {
        policies.file_of(name).name for name in made
    }
    for name, text in made.items():
        assert policies.file_of(name).read_text(encoding="utf-8") == text, "run: make reference"


def test_what_the_reconstruction_makes_for_a_calibration_is_allowed(nodes):
    calibrating = Node("calibrating", namespace=tables.NAMESPACE)
    try:
        InstrumentClient(calibrating, 1.0, 1.0, 1.0).subscribe()
        needed = policies.rights(calibrating)
    finally:
        calibrating.destroy_node()
    [node] = [node for node in nodes if node.get_name() == "reconstruction"]
    allowed = policies.rights(node)
    for key, names in needed.items():
        assert {name for name in names if "/calibrating/" not in name} <= allowed[key], key


def test_a_command_at_the_operators_terminal_may_make_its_node(nodes):
    """As `ros2 action send_goal` does; its names end in numbers of their own."""
    command = Node("_ros2cli_send_goal_4711", use_global_arguments=False)
    try:
        ActionClient(command, Scan, f"{tables.NAMESPACE}/scan")
        needed = policies.rights(command)
    finally:
        command.destroy_node()
    assert needed["services", "reply"]
    root = ElementTree.parse(policies.file_of(policies.OPERATOR))
    for (element, right), names in needed.items():
        groups = [group for group in root.iter(element) if group.get(right) == "ALLOW"]
        allowed = [str(item.text) for group in groups for item in group]
        refused = {name for name in names if not any(fnmatch(name, text) for text in allowed)}
        assert refused == set(), f"{element} {right}"


def test_only_scanner_and_reconstruction_may_light_the_laser_under_sros2(nodes):
    for node in nodes:
        rights = policies.rights(node)
        lights = {"/eschorty/laser/heartbeat"} & rights["topics", "publish"]
        lights |= {"/eschorty/laser/arm"} & rights["services", "request"]
        assert bool(lights) == (node.get_name() in ("scanner", "reconstruction")), node.get_name()
    assert "heartbeat" not in policies.file_of(policies.OPERATOR).read_text().split("subscribe")[0]
