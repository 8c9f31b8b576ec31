"""No two instruments on a host get the same ROS domain."""

import contextlib
import os
import socket
import subprocess
import sys

import pytest

from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.nodes.ros import domain
from eschorty_ros.nodes.ros.domain import free_domain

# Of domains that the other tests do not reserve.
ASK = """
import sys
from eschorty_ros.nodes.ros import domain
domain._DOMAINS = tuple(range(20, 50))
print(*(domain.free_domain() for _ in range(10)), flush=True)
sys.stdin.readline()
"""


def test_a_chosen_domain_stays_reserved_before_any_node_is_on_it() -> None:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    found: list[int] = []
    with contextlib.ExitStack() as running:
        for _ in range(2):
            asked = subprocess.Popen(
                [sys.executable, "-c", ASK],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env=environment,
            )
            running.enter_context(asked)
            running.callback(asked.communicate, b"\n")
            assert asked.stdout is not None
            found += map(int, asked.stdout.readline().split())
    assert len(set(found)) == 20


def test_free_domains_are_high_ones() -> None:
    assert free_domain() >= 60


def test_a_domain_is_taken_while_any_participant_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    taken = free_domain()
    monkeypatch.setattr(domain, "_DOMAINS", [taken])
    assert free_domain() == taken
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as participant:
        participant.bind(("", 7400 + 250 * taken + 10 + 2 * 3))
        with pytest.raises(DeviceError, match="set ROS_DOMAIN_ID"):
            free_domain()
