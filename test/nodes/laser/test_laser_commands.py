"""The laser node's services while one of them is in progress."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

import rclpy
from eschorty_ros.msg import LaserState
from held_laser import HeldLaser
from rclpy.context import Context
from rclpy.executors import MultiThreadedExecutor
from ros_process import NAMESPACE, Observer, wait_until
from spinning import spinning
from std_msgs.msg import Bool, Header
from std_srvs.srv import SetBool, Trigger
from waiting import DEADLINE_S

from eschorty_ros.control.laser_interlock import CLIENT_HEARTBEAT
from eschorty_ros.nodes.laser.node import THREADS, LaserNode
from eschorty_ros.nodes.ros import drivers, qos
from eschorty_ros.nodes.ros.domain import free_domain


@pytest.fixture
def observer() -> Iterator[Observer]:
    with Observer(free_domain(), "laser_observer") as made:
        yield made


@pytest.fixture
def laser(monkeypatch: pytest.MonkeyPatch, observer: Observer) -> Iterator[HeldLaser]:
    held = HeldLaser()
    monkeypatch.setattr(drivers, "make", lambda *_: held)
    context = Context()
    # One heartbeat and one arming must last, whatever delays this process.
    given = ("-p", "watch:=none", "-p", "heartbeat_timeout:=60.0", "-p", "arm_timeout:=3600.0")
    rclpy.init(args=["--ros-args", *given], context=context, domain_id=observer.domain)
    node = LaserNode(context=context, namespace=NAMESPACE)
    executor = MultiThreadedExecutor(THREADS, context=context)
    executor.add_node(node)
    with spinning(executor):
        yield held
        held.go.set()
    node.safe_state()
    node.destroy_node()
    context.try_shutdown()


def test_disabling_does_not_wait_for_enabling(observer: Observer, laser: HeldLaser) -> None:
    observer.wait_for_state("laser", "active")
    heartbeat = observer.publisher(Header, CLIENT_HEARTBEAT, qos.heartbeat())
    wait_until(heartbeat.get_subscription_count, "the heartbeat's subscriber")
    heartbeat.publish(Header())
    wait_until(lambda: observer.call(Trigger, "laser/arm").success, "arming")
    laser.hold = "enable"
    enabling = threading.Thread(
        target=lambda: observer.call(SetBool, "laser/enable", SetBool.Request(data=True))
    )
    enabling.start()
    assert laser.reached.wait(DEADLINE_S)
    off = threading.Thread(
        target=lambda: observer.call(SetBool, "laser/enable", SetBool.Request(data=False))
    )
    off.start()
    assert laser.disabled.wait(0.5 * DEADLINE_S), "disabling waits"
    laser.go.set()
    enabling.join()
    off.join()
    assert laser.enablings == 0


def test_interlock_that_is_reported_open_repeatedly_switches_off_once(
    observer: Observer, laser: HeldLaser
) -> None:
    observer.wait_for_state("laser", "active")
    states = observer.collect(LaserState, "laser/state", qos.latched(qos.STATE_HISTORY))
    before = laser.offs
    interlock = observer.publisher(Bool, "laser/interlock", qos.stream(10))
    for _ in range(5):
        interlock.publish(Bool(data=True))
    wait_until(lambda: states and states[-1].interlock_open, "the open interlock")
    interlock.publish(Bool(data=False))
    wait_until(lambda: not states[-1].interlock_open, "the closed interlock")
    assert laser.offs == before + 1
