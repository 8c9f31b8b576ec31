"""Serialized event packets: each field where the message's own serialization puts it."""

from array import array

import pytest
from event_camera_msgs.msg import EventPacket
from rclpy.serialization import serialize_message

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.nodes.reconstruction.inputs import packet_from_message


def event_packet(frame_id="eschorty_optical", encoding="evt3", events=b"\x01\x80\x02\x70"):
    message = EventPacket(seq=(1 << 64) - 2, time_base=7, height=720, width=1280)
    message.encoding, message.is_bigendian = encoding, True
    message.events = array("B", events)
    message.header.frame_id = frame_id
    message.header.stamp.sec, message.header.stamp.nanosec = 1_800_000_000, 987_654_321
    return bytes(serialize_message(message))


@pytest.mark.parametrize("length", range(9))
@pytest.mark.parametrize("events", [b"", b"\x01\x80\x02\x70", bytes(range(256)) * 300])
def test_a_packet_has_the_fields_of_its_message(length, events):
    packet = packet_from_message(event_packet("f" * length, events=events), b"camera")
    assert packet.seq == (1 << 64) - 2
    assert packet.stamp_ns == 1_800_000_000_987_654_321
    assert bytes(packet.data) == events
    assert packet.source == b"camera"


@pytest.mark.parametrize("encoding", ["", "evt2", "evt30", "mono", "\u00e9"])
def test_another_encoding_is_refused(encoding):
    with pytest.raises(ArgumentError, match="set the camera to evt3"):
        packet_from_message(event_packet(encoding=encoding), b"")


def test_a_packet_cut_anywhere_is_refused():
    whole = event_packet()
    for size in range(len(whole)):
        with pytest.raises(ArgumentError):
            packet_from_message(whole[:size], b"")


def test_big_endian_is_refused():
    with pytest.raises(ArgumentError, match="little-endian"):
        packet_from_message(b"\0\0" + event_packet()[2:], b"")
