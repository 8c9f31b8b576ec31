"""All nodes in one process, as the commands run them."""

import gc

from eschorty_ros.action import Scan
from waiting import wait_until

from eschorty_ros.nodes.one_process.composition import NODES, composition


def test_nodes_mark_their_names_to_the_end():
    """By its mark another node of the name knows that it is the second one."""
    with composition({}, (Scan, "scan")) as running:
        gc.collect()

        def marked() -> set[str]:
            names = running.client.get_node_names()
            return {name for name in NODES for mark in names if mark.startswith(f"_{name}_runs_")}

        wait_until(lambda: marked() == set(NODES), "the marks of all nodes", 2.0)
