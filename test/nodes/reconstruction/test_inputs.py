"""Serialized event packets: each field where the message's own serialization puts it."""

from array import array

import pytest
from event_camera_msgs.msg import EventPacket
from rclpy.serialization import serialize_message

from eschorty_ros.core.base.errors import ArgumentError, CalibrationError
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.nodes.reconstruction.inputs import packet_from_message

BUILD = load_calibration("config_3")


def event_packet(
    frame_id="eschorty_optical", encoding="evt3", events=b"\x01\x80\x02\x70", width=1280, height=720
):
    message = EventPacket(seq=(1 << 64) - 2, time_base=7, height=height, width=width)
    message.encoding, message.is_bigendian = encoding, True
    message.events = array("B", events)
    message.header.frame_id = frame_id
    message.header.stamp.sec, message.header.stamp.nanosec = 1_800_000_000, 987_654_321
    return bytes(serialize_message(message))


@pytest.mark.parametrize("length", range(9))
@pytest.mark.parametrize("events", [b"", b"\x01\x80\x02\x70", bytes(range(256)) * 300])
def test_a_packet_has_the_fields_of_its_message(length, events):
    packet = packet_from_message(event_packet("f" * length, events=events), b"camera", BUILD)
    assert packet.seq == (1 << 64) - 2
    assert packet.stamp_ns == 1_800_000_000_987_654_321
    assert bytes(packet.data) == events
    assert packet.source == b"camera"


@pytest.mark.parametrize("encoding", ["", "evt2", "evt30", "mono", "\u00e9"])
def test_another_encoding_is_refused(encoding):
    with pytest.raises(ArgumentError, match="set the camera to evt3"):
        packet_from_message(event_packet(encoding=encoding), b"", BUILD)


def test_a_packet_cut_anywhere_is_refused():
    whole = event_packet()
    for size in range(len(whole)):
        with pytest.raises(ArgumentError):
            packet_from_message(whole[:size], b"", BUILD)


def test_big_endian_is_refused():
    with pytest.raises(ArgumentError, match="little-endian"):
        packet_from_message(b"\0\0" + event_packet()[2:], b"", BUILD)


def test_a_smaller_sensor_is_refused_and_a_larger_or_unknown_one_taken():
    with pytest.raises(CalibrationError, match="of a sensor of 640 x 480 and config_3 of one of"):
        packet_from_message(event_packet(width=640, height=480), b"", BUILD)
    for size in ({"width": 0, "height": 0}, {"width": 1920, "height": 1080}):
        assert packet_from_message(event_packet(**size), b"", BUILD).source == b""
