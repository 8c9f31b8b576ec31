"""Devices and reconstruction on two hosts: network namespaces with a link that loses frames.

They change the network of the host, so they run only where ``ESCHORTY_TWO_HOSTS`` is set.
"""

import contextlib
import os
from pathlib import Path
from unittest import mock

import pytest
import scan_scenarios as scenarios
from benches import remote_bench
from lossy_link import TwoHosts, missing
from ros_process import processes

from eschorty_ros.core.base.files import config_folders
from eschorty_ros.nodes.ros.dds import NETWORK, RANGE, VARIABLES

SWITCH = "ESCHORTY_TWO_HOSTS"
# In namespaces of their own.
DOMAIN = 7
DEVICES = 3


@pytest.fixture(scope="module")
def instrument(tmp_path_factory):
    reason = missing() if SWITCH in os.environ else f"{SWITCH} is not set"
    if reason:
        pytest.skip(reason)
    log = Path(tmp_path_factory.mktemp("laser")) / "output.log"
    profile = next(path for folder in config_folders() for path in folder.glob(NETWORK))
    chosen = {RANGE: "SUBNET", VARIABLES[0]: str(profile)}
    with contextlib.ExitStack() as ending:
        ending.enter_context(mock.patch.dict(os.environ, chosen))
        hosts = ending.enter_context(TwoHosts())
        _, folder = ending.enter_context(remote_bench(**scenarios.bench_settings(log)))
        nodes = list(scenarios.node_parameters(folder).items())
        with hosts.on("a"):
            ending.enter_context(processes(dict(nodes[:DEVICES]), DOMAIN))
        with hosts.on("b"):
            ending.enter_context(processes(dict(nodes[DEVICES:]), DOMAIN))
            bench = ending.enter_context(scenarios.bench(DOMAIN, log))
        yield bench, hosts


@pytest.mark.parametrize("lost", [0.01, 0.05])
def test_lost_frames_cost_no_points(instrument, lost):
    bench, hosts = instrument
    hosts.lose(lost)
    scenarios.full_scan(bench)


def test_a_cut_link_ends_the_scan_and_the_next_one_works(instrument):
    bench, hosts = instrument
    hosts.lose(0.0)
    scenarios.cut_off(bench, lambda: hosts.lose(1.0), lambda: hosts.lose(0.0))
