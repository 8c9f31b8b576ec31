"""Publishing a camera's chunks as numbered event packets."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from event_camera_msgs.msg import EventPacket

from eschorty_ros.core.base.kernel import load_kernels
from eschorty_ros.core.evt3 import Decoder
from eschorty_ros.hardware.base.protocols import EventChunk
from eschorty_ros.live.packet_cutting import Packetizer
from eschorty_ros.nodes.ros.conversions import stamp_from_ns


class PacketPublisher:
    """Publishes one camera's stream; used by one thread at a time.

    A gap skips one number, a restart resets it to 0, so that subscribers notice both. Bytes
    without a subscriber count as a gap after the first packet.

    Public attributes:
    - ``seq``: Number of the next packet.
    - ``packets``, ``published_bytes``, ``unsubscribed_bytes``: Packets and bytes published, and
      bytes without a subscriber.
    - ``late_s``: Time by which the newest chunk waited for publication, or an emulated camera is
      late; 0 once none waits.
    - ``on``, ``off``: Events by polarity, published or not.
    """

    def __init__(self, publisher: Any, frame_id: str) -> None:
        self.seq = 0
        self.packets = 0
        self.published_bytes = 0
        self.unsubscribed_bytes = 0
        self.late_s = 0.0
        self.on = 0
        self.off = 0
        self._decoder = Decoder()
        # Now, not while events wait.
        load_kernels()
        self._publisher = publisher
        self._width = self._height = 0
        self._frame_id = frame_id
        self._gap = False
        self._packetizer = Packetizer(0, 2)

    @property
    def losses(self) -> dict[str, int]:
        """Return the events that the sensor reports as dropped, by name."""
        counts = self._decoder.counters
        return {
            "sensor_drop_words": counts.sensor_drop_words,
            "erc_events_in": counts.erc_events_in,
            "erc_events_dropped": max(counts.erc_events_in - counts.erc_events_out, 0),
        }

    @property
    def trigger_edges(self) -> int:
        """Return the number of edges at the camera's trigger input."""
        return self._decoder.counters.triggers

    @property
    def dark(self) -> bool:
        """Return whether packets wait longer, since the laser is known to be off."""
        return self._packetizer.dark

    @dark.setter
    def dark(self, value: bool) -> None:
        self._packetizer.dark = value

    def begin(self, width: int, height: int, age_ns: int, size_bytes: int) -> None:
        """Publish a sensor of this size in packets of this age or size."""
        if (width, height) != (self._decoder.width, self._decoder.height):
            self._decoder = Decoder(width, height)
        self._width, self._height = width, height
        self._packetizer = Packetizer(age_ns, size_bytes, self.dark)

    def push(self, chunk: EventChunk | None, now_ns: int) -> None:
        """Publish the packets that are due; ``None`` is a wait without data."""
        if chunk is None:
            self.late_s = 0.0
            self._publish(self._packetizer.push(b"", now_ns))
            return
        if chunk.gap or chunk.restarted:
            self.flush()
            self.seq = 0 if chunk.restarted else self.seq + 1
            self._decoder.note_gap()
        polarity = self._decoder.decode(chunk.data).p
        on = int(np.count_nonzero(polarity))
        self.on += on
        self.off += polarity.size - on
        self.late_s = (now_ns - chunk.arrival_ns) * 1e-9
        self._publish(self._packetizer.push(chunk.data, chunk.arrival_ns))

    def flush(self) -> None:
        """Publish the last, incomplete packet."""
        self._publish(self._packetizer.flush())

    def _publish(self, payloads: Iterable[tuple[int, bytes]]) -> None:
        for stamp_ns, payload in payloads:
            if self._publisher.get_subscription_count() == 0:
                self.unsubscribed_bytes += len(payload)
                self._gap = True
                continue
            if self._gap and self.seq:
                self.seq += 1
            self._gap = False
            message = EventPacket(
                height=self._height,
                width=self._width,
                seq=self.seq,
                encoding="evt3",
                is_bigendian=False,
            )
            message.events.frombytes(payload)
            message.header.stamp = stamp_from_ns(stamp_ns)
            message.header.frame_id = self._frame_id
            self._publisher.publish(message)
            self.seq += 1
            self.packets += 1
            self.published_bytes += len(payload)
