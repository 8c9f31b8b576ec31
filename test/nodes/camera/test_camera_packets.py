"""Numbers of the packets, from which subscribers notice gaps and restarts."""

from eschorty_ros.hardware.base.protocols import EventChunk
from eschorty_ros.nodes.camera.packet_publisher import PacketPublisher


class Publisher:
    """Records the numbers of the packets; ``subscribers`` is what ROS would count."""

    def __init__(self):
        self.subscribers = 1
        self.seqs = []
        self.sizes = set()

    def get_subscription_count(self):
        return self.subscribers

    def publish(self, message):
        self.seqs.append(message.seq)
        self.sizes.add((message.width, message.height))


def begun(publisher):
    packets = PacketPublisher(publisher, "f")
    packets.begin(640, 480, 0, 2)
    return packets


def push(packets, count, **marks):
    for k in range(count):
        packets.push(EventChunk(b"\0\0", k, **(marks if k == 0 else {})), k)


def test_gaps_and_restarts_show_in_the_numbers():
    publisher = Publisher()
    packets = begun(publisher)
    push(packets, 3)
    push(packets, 2, gap=True)
    push(packets, 2, restarted=True)
    assert publisher.seqs == [0, 1, 2, 4, 5, 0, 1]
    assert publisher.sizes == {(640, 480)}


def test_bytes_without_a_subscriber_are_a_gap_after_the_first_packet():
    publisher = Publisher()
    packets = begun(publisher)
    publisher.subscribers = 0
    push(packets, 5)
    publisher.subscribers = 1
    push(packets, 2)
    publisher.subscribers = 0
    push(packets, 5)
    publisher.subscribers = 1
    push(packets, 2)
    assert publisher.seqs == [0, 1, 3, 4]
    assert packets.unsubscribed_bytes == 20


def test_a_delay_is_over_once_no_chunk_waits():
    packets = begun(Publisher())
    packets.push(EventChunk(b"\0\0", 0), 500_000_000)
    assert packets.late_s == 0.5
    packets.push(None, 600_000_000)
    assert packets.late_s == 0.0
