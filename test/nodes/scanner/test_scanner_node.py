"""The scanner by itself: names of scans, and what it says while it cannot begin."""

import pytest
from eschorty_ros.action import Scan
from ros_process import NAMESPACE, nodes_here
from scan_scenarios import Goals

from eschorty_ros.nodes.scanner.node import ScannerNode

GOAL = {"start": 0.01, "stop": 0.02, "speed": 0.05}


@pytest.fixture
def scanner(observer):
    """A function that starts a scanner; it returns the goals of its scans."""
    with nodes_here(observer.domain, 4) as start:

        def started(namespace=NAMESPACE, **parameters):
            start(lambda **given: ScannerNode(**(given | {"namespace": namespace})), **parameters)
            return Goals(observer, Scan, f"{namespace}/scan", f"{namespace}/scanner")

        yield started


def test_scans_of_two_units_in_one_graph_have_different_names(scanner):
    units = [scanner(unit, node_timeout=0.1) for unit in ("/left", "/right")]
    for unit in units:
        unit.start(**GOAL)
    names = [unit.end()[1].scan_id for unit in units]
    assert names[0].rpartition("-")[2] != names[1].rpartition("-")[2]


def test_simulated_time_without_a_clock_is_named_while_the_scan_waits(scanner):
    goals = scanner(use_sim_time=True)
    goals.start(**GOAL)
    goals.wait_for(lambda feedback: "/clock" in feedback.waits_for, "the missing clock")
