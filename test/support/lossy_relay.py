"""A node between publishers and subscribers that loses messages at random."""

import random
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import rclpy
from event_camera_msgs.msg import EventPacket
from rclpy.node import Node
from ros_process import NAMESPACE
from std_msgs.msg import Header

from eschorty_ros.nodes.ros import qos
from eschorty_ros.nodes.ros.executor import Spinning

SEED = 20261122
DRIVER, EVENTS = "event_camera", "/event_camera/events"


class LossyRelay(Node):
    """``near/NAME`` to ``far/NAME`` for heartbeats; ``near/events`` as metavision_driver's.

    Public attributes:
    - ``lost``: Share of each type's messages that are lost, by name of the type: of each
      ``1 / share`` messages a random one.
    """

    def __init__(self, context: rclpy.Context, heartbeats: tuple[str, ...]) -> None:
        super().__init__(DRIVER, namespace=NAMESPACE, context=context)
        self.lost = {"EventPacket": 0.0, "Header": 0.0}
        self._passed = dict.fromkeys(self.lost, 0)
        self._next_lost = dict.fromkeys(self.lost, 0)
        self._random = random.Random(SEED)
        self._carry(EventPacket, "near/events", EVENTS, qos.stream(1000), qos.events())
        for name in heartbeats:
            profile = qos.heartbeat()
            self._carry(Header, f"near/{name}", f"far/{name}", profile, profile)

    def _carry(self, kind: Any, source: str, target: str, received: Any, sent: Any) -> None:
        publisher = self.create_publisher(kind, target, sent)
        self.create_subscription(kind, source, partial(self._pass, publisher), received)

    def _pass(self, publisher: Any, message: Any) -> None:
        if not self._is_lost(type(message).__name__):
            publisher.publish(message)

    def _is_lost(self, kind: str) -> bool:
        if not self.lost[kind]:
            return False
        run = round(1.0 / self.lost[kind])
        place = self._passed[kind] % run
        if place == 0:
            self._next_lost[kind] = self._random.randrange(run)
        self._passed[kind] += 1
        return place == self._next_lost[kind]


@contextmanager
def lossy_relay(domain: int, *heartbeats: str) -> Iterator[LossyRelay]:
    """Yield a relay that runs within the context."""
    print(f"lossy relay: seed {SEED}")
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    spinning = Spinning(1, context)
    relay = LossyRelay(context, heartbeats)
    spinning.executor.add_node(relay)
    spinning.start()
    try:
        yield relay
    finally:
        spinning.end()
    relay.destroy_node()
    context.try_shutdown()
