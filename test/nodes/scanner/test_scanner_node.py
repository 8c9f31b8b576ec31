"""The scanner by itself: names of scans, and what it says while it cannot begin."""

import time

import pytest
from delayed_laser import DelayedLaser
from diagnostic_msgs.msg import DiagnosticArray
from eschorty_ros.action import Scan
from rclpy.node import Node
from ros_process import NAMESPACE, nodes_here, wait_until
from scan_scenarios import Goals

from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.nodes.laser.node import LaserNode
from eschorty_ros.nodes.ros import drivers, qos
from eschorty_ros.nodes.scanner.node import ScannerNode

GOAL = {"start": 0.01, "stop": 0.02, "speed": 0.05}


@pytest.fixture
def start(observer):
    """A function that starts nodes: ``(kind, **parameters)``."""
    with nodes_here(observer.domain, 4) as made:
        yield made


def scans(observer, start, namespace=NAMESPACE, **parameters):
    """Return the goals of a new scanner."""
    start(lambda **given: ScannerNode(**(given | {"namespace": namespace})), **parameters)
    return Goals(observer, Scan, f"{namespace}/scan", f"{namespace}/scanner")


def test_scans_of_two_units_in_one_graph_have_different_names(observer, start):
    units = [scans(observer, start, unit, node_timeout=0.1) for unit in ("/left", "/right")]
    for unit in units:
        unit.start(**GOAL)
    names = [unit.end()[1].scan_id for unit in units]
    assert names[0].rpartition("-")[2] != names[1].rpartition("-")[2]


def test_simulated_time_without_a_clock_is_named_while_the_scan_waits(observer, start):
    reports = observer.collect(DiagnosticArray, "/diagnostics", qos.stream())
    goals = scans(observer, start, use_sim_time=True)
    goals.start(**GOAL)
    goals.wait_for(lambda feedback: "/clock" in feedback.waits_for, "the missing clock")
    wait_until(
        lambda: any("scan waits: " in array.status[0].message for array in list(reports)),
        "the missing clock in the diagnostics",
    )


class Starting(Node):
    """A reconstruction that is being made."""

    def __init__(self, **given):
        super().__init__("reconstruction", **given)

    def safe_state(self):
        """Do nothing: it has no device."""


def test_a_reconstruction_that_still_compiles_is_named_with_the_remedy(
    observer, start, monkeypatch
):
    """Its node is there, and offers nothing before its kernels are compiled."""
    monkeypatch.setattr(drivers, "make", lambda *_: DelayedLaser())
    start(Starting)
    start(LaserNode)
    goals = scans(observer, start, node_timeout=5.0)
    goals.start(**GOAL)
    _, result = goals.end()
    assert result.message.startswith("reconstruction: no reconstruction/begin_scan within 5 s; ")
    assert "run `eschorty compile` before" in result.message


class Lost(DelayedLaser):
    """Reads nothing back once it is ``gone``; switches off all the same if ``confirmed``."""

    gone = confirmed = False

    def disable(self):
        if self.gone and not self.confirmed:
            raise DeviceError("switch the generator off by hand")
        super().disable()

    def readback(self):
        if self.gone:
            raise DeviceError("no answer")
        return super().readback()


@pytest.mark.parametrize(
    ("confirmed", "reason"),
    [
        (False, "state unknown: switch the generator off by hand"),
        (True, "not read back: no answer"),
    ],
)
def test_a_laser_that_has_failed_ends_the_scan_at_once_with_its_reason(
    observer, start, monkeypatch, confirmed, reason
):
    laser = Lost()
    laser.confirmed = confirmed
    monkeypatch.setattr(drivers, "make", lambda *_: laser)
    goals = scans(observer, start)
    start(LaserNode)
    observer.wait_for_state("laser", "active")
    laser.gone = True
    observer.wait_for_state("laser", "unconfigured")
    begun_s = time.monotonic()
    goals.start(**GOAL)
    _, result = goals.end()
    assert result.message == f"laser: {reason}"
    assert time.monotonic() - begun_s < 10.0
    laser.gone = False
