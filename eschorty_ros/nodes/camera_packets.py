"""From a camera's chunks to event packets: cutting, numbering, counting."""

from __future__ import annotations

import array
from collections.abc import Iterable
from typing import Any

from event_camera_msgs.msg import EventPacket

from eschorty_ros.core.evt3_count import WordCounter
from eschorty_ros.hardware.protocols import EventChunk
from eschorty_ros.nodes.conversions import stamp_from_ns
from eschorty_ros.nodes.packets import Packetizer


class PacketPublisher:
    """Publishes one camera's stream; used by one thread at a time.

    A gap leaves one number out, a restart begins at 0 again: that is how readers learn of both.
    What is not sent for want of a subscriber is a gap, too, once there has been one.

    Parameters
    ----------
    publisher : rclpy publisher of EventPacket
    width, height : int
    frame_id : str

    Attributes
    ----------
    seq : int
        Number of the next packet.
    packets, published_bytes, unheard_bytes : int
        Packets and bytes sent, and bytes not sent because nobody listened.
    words : WordCounter
        What was in all of them.
    """

    def __init__(self, publisher: Any, width: int, height: int, frame_id: str) -> None:
        self.seq = 0
        self.packets = 0
        self.published_bytes = 0
        self.unheard_bytes = 0
        self.words = WordCounter()
        self._publisher = publisher
        self._width = width
        self._height = height
        self._frame_id = frame_id
        self._unheard = False
        self._packetizer = Packetizer(0, 2)

    @property
    def losses(self) -> dict[str, int]:
        """What the sensor says of events it dropped, by name."""
        words = self.words
        return {
            "sensor_drop_words": words.drop_words,
            "erc_events_in": words.erc_events_in,
            "erc_events_dropped": max(words.erc_events_in - words.erc_events_out, 0),
        }

    def cut_by(self, age_ns: int, size_bytes: int) -> None:
        """Let packets leave at this age or size."""
        self._packetizer = Packetizer(age_ns, size_bytes)

    def take(self, chunk: EventChunk | None, now_ns: int) -> None:
        """Publish what is due; ``None`` lets time pass."""
        if chunk is None:
            self._publish(self._packetizer.push(b"", now_ns))
            return
        if chunk.gap or chunk.restarted:
            self.flush()
            self.seq = 0 if chunk.restarted else self.seq + 1
        self.words.add(chunk.data)
        self._publish(self._packetizer.push(chunk.data, chunk.arrival_ns))

    def flush(self) -> None:
        """Publish what is left."""
        self._publish(self._packetizer.flush())

    def _publish(self, payloads: Iterable[tuple[int, bytes]]) -> None:
        for stamp_ns, payload in payloads:
            if self._publisher.get_subscription_count() == 0:
                self.unheard_bytes += len(payload)
                self._unheard = True
                continue
            if self._unheard and self.seq:
                self.seq += 1
            self._unheard = False
            message = EventPacket(
                height=self._height,
                width=self._width,
                seq=self.seq,
                encoding="evt3",
                is_bigendian=False,
                events=array.array("B", payload),
            )
            message.header.stamp = stamp_from_ns(stamp_ns)
            message.header.frame_id = self._frame_id
            self._publisher.publish(message)
            self.seq += 1
            self.packets += 1
            self.published_bytes += len(payload)
