"""Camera drivers' packets of a recording: those of our node and those of metavision_driver."""

from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from event_camera_msgs.msg import EventPacket

from eschorty_ros.core.evt3 import Decoder
from eschorty_ros.core.storage import Recording
from eschorty_ros.core.storage.raw_file import RawReader
from eschorty_ros.live.packet_cutting import Packetizer
from eschorty_ros.nodes.ros.conversions import stamp_from_ns

PIECE_BYTES = 512
THRESHOLD_NS = 4_000_000


@dataclass(frozen=True)
class Driver:
    """A driver's node, topic and parameters, and how it cuts what arrives into packets."""

    node: str
    topic: str
    reliability: str
    frame_id: str
    cut: Callable[[Iterator[tuple[int, bytes]]], Iterator[tuple[int, bytes]]]

    def packets(self, recording: Recording, zero_ns: int) -> Iterator[EventPacket]:
        """The recording, whose sensor time 0 is ``zero_ns``, as the driver publishes it."""
        header = RawReader(recording.events_path).header
        arrivals = _arrivals(recording, zero_ns)
        for seq, (stamp_ns, data) in enumerate(self.cut(arrivals)):
            message = EventPacket(height=header.height, width=header.width, seq=seq,
                                  encoding="evt3", events=array("B", data))  # fmt: skip
            message.header.stamp = stamp_from_ns(stamp_ns)
            message.header.frame_id = self.frame_id
            yield message


def _arrivals(recording: Recording, zero_ns: int) -> Iterator[tuple[int, bytes]]:
    """What the USB delivers, 1 ms of sensor time at a time: (arrival, bytes)."""
    reader = RawReader(recording.events_path)
    decoder = Decoder(reader.header.width, reader.header.height)
    pending = bytearray()
    begun_us = 0
    for piece in reader.chunks(PIECE_BYTES):
        decoder.decode(piece)
        pending += piece
        now_us = decoder.time_us or 0
        if now_us - begun_us >= 1000:
            yield zero_ns + 1000 * now_us, bytes(pending)
            pending.clear()
            begun_us = now_us
    yield zero_ns + 1000 * begun_us, bytes(pending)


def _as_our_camera(arrivals: Iterator[tuple[int, bytes]]) -> Iterator[tuple[int, bytes]]:
    packetizer = Packetizer(THRESHOLD_NS, 128_000)
    for arrival_ns, data in arrivals:
        yield from packetizer.push(data, arrival_ns)
    yield from packetizer.flush()


def _as_metavision_driver(arrivals: Iterator[tuple[int, bytes]]) -> Iterator[tuple[int, bytes]]:
    """Its age is that since the packet before, and only an arrival ends a packet."""
    pending = bytearray()
    first_ns = sent_ns = 0
    for arrival_ns, data in arrivals:
        first_ns = first_ns if pending else arrival_ns
        pending += data
        if arrival_ns - sent_ns >= THRESHOLD_NS:
            yield first_ns, bytes(pending)
            pending.clear()
            sent_ns = arrival_ns


OURS = Driver("camera", "/eschorty/camera/events", "reliable", "eschorty_optical", _as_our_camera)
METAVISION = Driver(
    "event_camera", "/event_camera/events", "best_effort", "0a1b", _as_metavision_driver
)
