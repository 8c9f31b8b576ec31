"""The transports of the nodes."""

from pathlib import Path

import pytest
from ros_process import NodeProcess, Observer

from eschorty_ros.nodes.ros.dds import RANGE, VARIABLES


@pytest.mark.parametrize("range_", [None, "LOCALHOST"])
def test_a_node_uses_no_shared_memory(range_, monkeypatch) -> None:
    with Observer() as observer:
        for name in (*VARIABLES, RANGE):
            monkeypatch.delenv(name, raising=False)
        if range_ is not None:
            monkeypatch.setenv(RANGE, range_)
        with NodeProcess("eschorty_ros.nodes.scanner.node", {}, domain=observer.domain) as node:
            observer.wait_for_answers("scanner")
            assert "/dev/shm/fastdds" not in Path(f"/proc/{node.pid}/maps").read_text()
