"""The transports of the nodes."""

import subprocess
import sys
from pathlib import Path

import pytest
from ros_process import NodeProcess, Observer, domain_environment

from eschorty_ros.nodes.ros.dds import RANGE, VARIABLES
from eschorty_ros.nodes.ros.domain import free_domain

BURST = """
import gc
import time
from pathlib import Path

import rclpy
from rclpy.node import Node
from std_msgs.msg import UInt8MultiArray

from eschorty_ros.nodes.ros import qos
from eschorty_ros.nodes.ros.dds import use_profile
from eschorty_ros.nodes.ros.freed_memory import FreedMemory

monotonic = time.monotonic


def resident_mb():
    gc.collect()
    freed = FreedMemory()
    time.monotonic = lambda: monotonic() + 20.0
    freed.trim()
    time.monotonic = monotonic
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6


use_profile()
rclpy.init()
node = Node("burst")
received = []
kind, depth = UInt8MultiArray, qos.stream(200)
node.create_subscription(kind, "burst", lambda message: received.append(message.data[0]), depth)
publisher = node.create_publisher(kind, "burst", depth)
while not publisher.get_subscription_count():
    rclpy.spin_once(node, timeout_sec=0.1)
before_mb = resident_mb()
for number in range(100):
    publisher.publish(UInt8MultiArray(data=bytes([number]) * 1_000_000))
waiting_mb = resident_mb() - before_mb
while len(received) < 100:
    rclpy.spin_once(node, timeout_sec=0.1)
assert received == list(range(100))
print(waiting_mb, resident_mb() - before_mb)
"""


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


def test_the_memory_of_messages_that_waited_is_freed(monkeypatch) -> None:
    for name in (*VARIABLES, RANGE):
        monkeypatch.delenv(name, raising=False)
    ended = subprocess.run(
        [sys.executable, "-c", BURST],
        env=domain_environment(free_domain()),
        check=True,
        stdout=subprocess.PIPE,
    )
    waiting_mb, left_mb = map(float, ended.stdout.split())
    assert waiting_mb > 90.0
    assert left_mb < 0.3 * waiting_mb
