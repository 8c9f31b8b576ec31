"""docs/interfaces.md describes every topic, service, action and parameter of the nodes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

import interfaces as tables
from rclpy.node import Node

README = Path(__file__).resolve().parents[2] / "README.md"


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


def test_the_readme_names_every_topic_of_the_instrument(nodes):
    text = README.read_text(encoding="utf-8")
    elsewhere = {"camera/clock"}
    assert [name for name in set(tables.topics(nodes)) - elsewhere if name not in text] == []
