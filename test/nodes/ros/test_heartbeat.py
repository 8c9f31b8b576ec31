"""A heartbeat whose publisher fails for a while."""

from typing import Any

from rclpy.node import Node
from ros_process import Observer, nodes_here, wait_until
from std_msgs.msg import Header

from eschorty_ros.nodes.ros import qos
from eschorty_ros.nodes.ros.heartbeat import Heartbeat

TOPIC = "test/heartbeat"


class Sender(Node):
    """A healthy node whose publisher of heartbeats raises ``failures`` times."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("sender", **kwargs)
        self.failures = 2
        Heartbeat(self, TOPIC, lambda: True)

    def create_publisher(self, kind: Any, topic: str, *args: Any, **kwargs: Any) -> Any:
        publisher = super().create_publisher(kind, topic, *args, **kwargs)
        if topic == TOPIC:
            publish = publisher.publish

            def fail_or_publish(message: Header) -> None:
                if self.failures:
                    self.failures -= 1
                    raise RuntimeError("no buffer")
                publish(message)

            publisher.publish = fail_or_publish
        return publisher

    def safe_state(self) -> None:
        pass


def test_a_heartbeat_that_is_not_sent_is_reported_and_the_next_one_is_sent(
    observer: Observer, capfd
) -> None:
    received = observer.collect(Header, TOPIC, qos.heartbeat())
    with nodes_here(observer.domain) as start:
        start(Sender)
        wait_until(lambda: received, "a heartbeat")
    assert f"{TOPIC} not sent: RuntimeError('no buffer')" in capfd.readouterr().err
