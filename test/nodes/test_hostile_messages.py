"""Messages, requests and goals from the types' extremes to every node, then a good scan."""

import contextlib
import random
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import scan_scenarios as scenarios
from benches import remote_bench
from contact import Contact
from hypothesis import HealthCheck, given, seed, settings
from message_values import interface, messages
from rclpy.action.server import RCLError
from ros_process import NAMESPACE, processes
from waiting import wait_until

from eschorty_ros.nodes.ros import qos
from eschorty_ros.nodes.ros.domain import free_domain

SEED = 12
MESSAGES, REQUESTS, BYTES = 12, 6, 6
NODES = ("camera", "laser", "stage", "reconstruction", "scanner")
# Of these rclpy answers none that it cannot read, the others wait for their goal.
UNANSWERED = ("parameter", "get_result", "send_goal")


@pytest.fixture(scope="module")
def instrument(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Five nodes, at first without their devices."""
    print(f"seed {SEED}")
    folder = tmp_path_factory.mktemp("hostile")
    domain = free_domain()
    settings_ = scenarios.bench_settings(folder / "output.log")
    with remote_bench(**settings_) as (_, bench_folder):
        nodes = scenarios.node_parameters(bench_folder)
        for name in ("camera", "laser", "stage"):
            nodes[f"eschorty_ros.nodes.{name}.node"]["auto_start"] = False
        nodes["eschorty_ros.nodes.reconstruction.node"]["calibration_folder"] = folder / "made"
        nodes["eschorty_ros.nodes.scanner.node"]["node_timeout"] = 5.0
        with (
            processes(nodes, domain) as running,
            scenarios.bench(domain, folder / "output.log") as bench,
        ):
            for name in NODES:
                bench.observer.wait_for_answers(name, scenarios.SCAN_DEADLINE_S)
            yield bench, running, Contact(bench.observer)


def test_nodes_without_devices_outlast_everything(instrument):
    bench, running, _ = instrument
    attack(bench.observer)
    assert_alive(running)


def test_a_good_scan_follows(instrument):
    bench, running, contact = instrument
    activate(bench.observer, contact)
    scenarios.full_scan(bench)
    assert_alive(running)


def test_nodes_at_work_outlast_everything_and_the_next_scan_is_good(instrument):
    bench, running, contact = instrument
    attack(bench.observer)
    assert_alive(running)
    activate(bench.observer, contact)
    scenarios.full_scan(bench)


def attack(observer: Any) -> None:
    """Send hostile values by every topic, service and action of the nodes."""
    node = observer.node
    for topic, kinds in node.get_topic_names_and_types():
        if any(end.node_name in NODES for end in node.get_subscriptions_info_by_topic(topic)):
            to_topic(observer, topic, interface(kinds[0]))
    for name, kinds in node.get_service_names_and_types():
        if name.startswith(f"{NAMESPACE}/") and "observer" not in name:
            to_service(observer, name, interface(kinds[0]))


def to_topic(observer: Any, topic: str, kind: Any) -> None:
    """Publish messages and random bytes; the publisher ends with it."""
    publisher = observer.publisher(kind, topic, qos.latched())
    try:
        each(messages(kind), MESSAGES, publisher.publish)
        rng = random.Random(SEED)
        for size in range(4, 4 + 40 * BYTES, 40):
            # More than any message of the type holds is not sent.
            with contextlib.suppress(RCLError):
                publisher.publish(b"\x00\x01\x00\x00" + rng.randbytes(size))
        publisher.wait_for_all_acked()
    finally:
        observer.node.destroy_publisher(publisher)


def to_service(observer: Any, name: str, kind: Any) -> None:
    """Send requests; those of the package's own services are answered."""
    client = observer.node.create_client(kind, name)
    try:
        wait_until(client.service_is_ready, f"service {name}")
        sent: list[Any] = []
        each(messages(kind.Request), REQUESTS, lambda r: sent.append(client.call_async(r)))
        if not any(word in name for word in UNANSWERED):
            wait_until(lambda: all(future.done() for future in sent), f"every answer of {name}")
    finally:
        observer.node.destroy_client(client)


def each(strategy: Any, count: int, use: Callable[[Any], None]) -> None:
    """Use so many values of a strategy, the same in every run."""

    @seed(SEED)
    @settings(max_examples=count, database=None, deadline=None,
              suppress_health_check=list(HealthCheck))  # fmt: skip
    @given(strategy)
    def run(value: Any) -> None:
        use(value)

    run()


def activate(observer: Any, contact: Contact) -> None:
    """Bring the devices from whatever state they are in to active; close the interlock."""
    for name in ("laser", "stage", "camera"):
        for transition in ("deactivate", "cleanup", "configure", "activate"):
            observer.change_state(name, transition)
        observer.wait_for_state(name, "active")
    contact.close()


def assert_alive(running: dict[str, Any]) -> None:
    time.sleep(1.0)
    for name, process in running.items():
        assert process.running(), f"{name} ended by {process.wait()}: {process.output[-6000:]}"
        assert "Traceback" not in process.output, f"{name}: {process.output[-6000:]}"
