"""Executors with and without rclpy's EventsExecutor: callback groups, errors, bounded queues."""

import functools
import threading
import time
from collections import deque
from collections.abc import Iterator
from typing import Any

import pytest
import rclpy
from eschorty_ros.action import MoveStage
from rclpy.action import ActionServer
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.node import Node
from ros_process import Observer
from std_msgs.msg import Int32
from std_srvs.srv import Trigger
from waiting import wait_until

from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.nodes.ros import executor
from eschorty_ros.nodes.ros.border import refusals

DEPTH = 3


@pytest.fixture(params=["events", "wait sets"])
def spun(request, monkeypatch) -> Iterator[tuple[Node, executor.Spinning, Observer]]:
    """A node, what spins it, and an observer."""
    with Observer() as observer:
        if request.param == "wait sets":
            monkeypatch.setattr(executor, "EventExecutor", executor.ThreadsExecutor)
        context = rclpy.Context()
        rclpy.init(context=context, domain_id=observer.domain)
        node = Node("spun", namespace="/eschorty", context=context)
        spinning = executor.Spinning(4, context)
        spinning.executor.add_node(node)
        spinning.start()
        try:
            yield node, spinning, observer
        finally:
            spinning.end()
            node.destroy_node()
            context.try_shutdown()


def test_a_waiting_service_holds_up_its_exclusive_group_alone(spun):
    node, _, observer = spun
    released, received, ticks = threading.Event(), [], []
    exclusive = MutuallyExclusiveCallbackGroup()

    def wait(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = released.wait(30.0)
        return response

    node.create_service(Trigger, "wait", wait, callback_group=exclusive)
    node.create_subscription(Int32, "held", received.append, 10, callback_group=exclusive)
    node.create_timer(
        0.01, lambda: ticks.append(len(received)), callback_group=ReentrantCallbackGroup()
    )
    client = observer.node.create_client(Trigger, "wait")
    wait_until(client.service_is_ready, "the service")
    answer = client.call_async(Trigger.Request())
    time.sleep(0.2)
    observer.publisher(Int32, "held", 10).publish(Int32(data=1))
    ticks.clear()
    wait_until(lambda: len(ticks) > 20, "the timer of another group")
    assert not received
    assert not answer.done()
    released.set()
    wait_until(lambda: received, "the message of the group")
    wait_until(answer.done, "the answer")
    assert answer.result().success


def test_of_the_messages_of_a_busy_callback_the_newest_are_kept(spun):
    node, _, observer = spun
    released, received = threading.Event(), []

    def slow(message: Int32) -> None:
        released.wait(30.0)
        received.append(message.data)

    node.create_subscription(Int32, "many", slow, DEPTH)
    publisher = observer.publisher(Int32, "many", DEPTH)
    for number in range(20):
        publisher.publish(Int32(data=number))
        time.sleep(0.01)
    released.set()
    wait_until(lambda: 19 in received, "the newest message")
    # One was in the callback; a wait set takes one more when that ends.
    assert received == sorted(received)
    assert len(received) <= DEPTH + 2


class _SlowQueue(deque[Any]):
    def append(self, item: Any) -> None:
        time.sleep(1e-3)
        super().append(item)


def test_the_last_of_many_messages_is_always_received(spun, monkeypatch):
    """While a message takes its place in the queue, the one before leaves it for the callback."""
    node, _, _ = spun
    monkeypatch.setattr(executor, "deque", _SlowQueue)
    received: list[int] = []

    def slow(message: Int32) -> None:
        time.sleep(3e-3)
        received.append(message.data)

    subscription = node.create_subscription(Int32, "last", slow, 1)
    for number in range(100):
        subscription.callback(Int32(data=number))
    wait_until(lambda: received[-1:] == [99], "the last message")


def test_errors_are_counted_and_the_node_goes_on(spun):
    node, spinning, observer = spun
    received = []

    def fail(message: Int32) -> None:
        received.append(message.data)
        raise ValueError("a value")

    def refuse(_: Trigger.Request, __: Trigger.Response) -> Trigger.Response:
        raise ValueError("a request")

    node.create_subscription(Int32, "bad", fail, 10)
    node.create_service(Trigger, "bad_request", refuse)
    publisher = observer.publisher(Int32, "bad", 10)
    for number in range(3):
        publisher.publish(Int32(data=number))
    wait_until(lambda: len(received) == 3, "every message")
    client = observer.node.create_client(Trigger, "bad_request")
    wait_until(client.service_is_ready, "the service")
    answer = client.call_async(Trigger.Request())
    wait_until(answer.done, "an answer")
    assert (answer.result().success, answer.result().message) == (False, "a request")
    wait_until(lambda: refusals(node).counts == {"bad": 3, "bad_request": 1}, "the counts")
    spinning.raise_error()


def test_an_error_of_an_action_or_a_task_does_not_end_the_process(spun):
    node, spinning, observer = spun
    failed, done = [], threading.Event()

    class FailingOnce(ActionServer):
        async def execute(self, data: Any) -> None:
            if not failed:
                failed.append(data)
                raise RuntimeError("the client is gone")
            await super().execute(data)

    def move(goal: Any) -> MoveStage.Result:
        goal.succeed()
        return MoveStage.Result()

    FailingOnce(node, MoveStage, "move", move)
    client = observer.action_client(MoveStage, "move")
    wait_until(client.server_is_ready, "the action")
    client.send_goal_async(MoveStage.Goal())
    wait_until(lambda: failed, "the goal that fails")
    spinning.executor.create_task(lambda: 1 // 0)
    spinning.executor.create_task(done.set)
    wait_until(done.is_set, "the task behind it")
    sent = client.send_goal_async(MoveStage.Goal())
    wait_until(sent.done, "the answer to the next goal")
    assert sent.result().accepted
    assert refusals(node).counts["FailingOnce"] == 1


def test_an_error_of_a_timer_ends_the_node(spun):
    node, spinning, _ = spun

    def fail() -> None:
        raise DeviceError("the device is gone")

    node.create_timer(0.01, fail)
    wait_until(lambda: spinning.executor.error is not None, "the error")
    with pytest.raises(DeviceError, match="the device is gone"):
        spinning.raise_error()


def test_a_canceled_timer_runs_no_more(spun):
    node, _, _ = spun
    runs, timers = [], []

    def once(number: int) -> None:
        runs.append(number)
        timers[number].cancel()

    for number in range(90):
        timers.append(node.create_timer(1e-3, functools.partial(once, number), autostart=False))
    for timer in timers:
        timer.reset()
    wait_until(lambda: len(set(runs)) == len(timers), "every timer")
    time.sleep(0.1)
    assert sorted(runs) == list(range(len(timers)))
