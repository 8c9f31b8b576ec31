"""Scans with another camera driver, losses between the nodes, and nodes that stop answering."""

import signal
from pathlib import Path

import pytest
import scan_scenarios as scenarios
from action_msgs.msg import GoalStatus
from benches import remote_bench
from lossy_relay import EVENTS, lossy_relay
from ros_process import Remap, processes

from eschorty_ros.nodes.ros.domain import free_domain

RELIABLE = "qos_overrides./eschorty/near/events.publisher.reliability"


def parameters(folder):
    """The five nodes, with the relay between them; its events are those of metavision_driver."""
    laser, stage, camera, reconstruction, scanner = scenarios.node_parameters(folder)
    far = {"camera/events": Remap(EVENTS)}
    heartbeats = {name: Remap(f"far/{name}") for name in ("laser/heartbeat", "stage/heartbeat")}
    return {
        laser: {"bench": folder, "watch": "stage", **heartbeats},
        stage: {"bench": folder, "stage/heartbeat": Remap("near/stage/heartbeat")},
        camera: {
            "bench": folder,
            "trigger_in_mode": "external",
            "camera/events": Remap("near/events"),
            RELIABLE: "reliable",
        },
        reconstruction: {"trigger_source": "stage", **far},
        scanner: {**far, "laser/heartbeat": Remap("near/laser/heartbeat")},
    }


@pytest.fixture(scope="module")
def instrument(tmp_path_factory):
    log = Path(tmp_path_factory.mktemp("laser")) / "output.log"
    domain = free_domain()
    with (
        remote_bench(**scenarios.bench_settings(log)) as (_, folder),
        lossy_relay(domain, "laser/heartbeat", "stage/heartbeat") as relay,
        processes(parameters(folder), domain) as running,
        scenarios.bench(domain, log) as bench,
    ):
        yield bench, running, relay


def test_a_scan_with_metavision_driver_and_five_percent_of_the_heartbeats_lost(instrument):
    bench, _, relay = instrument
    relay.lost["Header"] = 0.05
    scenarios.full_scan(bench)


def test_a_lost_packet_costs_at_most_the_points_of_the_two_periods_it_meets(instrument):
    bench, _, relay = instrument
    # One of 20: a short scan has some 50 packets.
    relay.lost["EventPacket"] = 0.05
    before = len(bench.clouds)
    status, result = bench.scan()
    assert status == GoalStatus.STATUS_SUCCEEDED or "partial" in result.message, result.message
    assert result.packets_lost > 0
    points, _ = bench.lit_part(bench.cloud_after(before, result.points))
    print(f"{result.packets_lost} packets lost")
    scenarios.assert_accurate(
        points,
        scenarios.positions_mm(),
        scenarios.BUT_ONE - 2 * result.packets_lost / scenarios.PERIODS,
    )
    bench.assert_off_and_at_rest()


def test_nodes_that_stop_answering_end_the_scan_and_the_next_one_works(instrument):
    bench, running, relay = instrument

    def send(number, lost):
        relay.lost.update(EventPacket=lost, Header=lost)
        for name in ("stage", "laser"):
            running[name].send(number)

    def cut():
        send(signal.SIGSTOP, 1.0)

    def join():
        send(signal.SIGCONT, 0.0)

    relay.lost.update(EventPacket=0.0, Header=0.0)

    scenarios.cut_off(bench, cut, join)
