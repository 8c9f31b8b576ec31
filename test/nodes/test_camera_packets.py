"""Numbers of the packets: what readers learn gaps and restarts from."""

import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from eschorty_ros.hardware.protocols import EventChunk
from eschorty_ros.nodes.camera_packets import PacketPublisher


class Publisher:
    """Keeps the numbers it is given while ``listeners`` is not 0."""

    def __init__(self):
        self.listeners = 1
        self.seqs = []

    def get_subscription_count(self):
        return self.listeners

    def publish(self, message):
        self.seqs.append(message.seq)


def taken(packets, count, **marks):
    for k in range(count):
        packets.take(EventChunk(b"\0\0", k, **(marks if k == 0 else {})), k)


def test_gaps_and_restarts_show_in_the_numbers():
    publisher = Publisher()
    packets = PacketPublisher(publisher, 1280, 720, "f")
    taken(packets, 3)
    taken(packets, 2, gap=True)
    taken(packets, 2, restarted=True)
    assert publisher.seqs == [0, 1, 2, 4, 5, 0, 1]


def test_what_nobody_heard_is_a_gap_but_not_before_the_first_listener():
    publisher = Publisher()
    packets = PacketPublisher(publisher, 1280, 720, "f")
    publisher.listeners = 0
    taken(packets, 5)
    publisher.listeners = 1
    taken(packets, 2)
    publisher.listeners = 0
    taken(packets, 5)
    publisher.listeners = 1
    taken(packets, 2)
    assert publisher.seqs == [0, 1, 3, 4]
    assert packets.unheard_bytes == 20
