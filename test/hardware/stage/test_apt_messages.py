"""APT layouts against thorlabs-apt-protocol, the manual's frames, and the protocol's scaling."""

import io
import struct
from typing import Any

import pytest
import thorlabs_apt_protocol as oracle

from eschorty_ros.hardware.stage import apt_messages as apt

BAY = 0x21
PULSES = {
    "start_forward": 40_000,
    "interval_forward": 40_000,
    "count_forward": 109,
    "start_reverse": 4_360_000,
    "interval_reverse": 40_000,
    "count_reverse": 109,
    "width_us": 500,
    "cycles": 7,
}

PACKED = [
    (apt.pack("connect", 0x50), oracle.hw_no_flash_programming(0x50, 1)),
    (apt.pack("disconnect", 0x50), oracle.hw_disconnect(0x50, 1)),
    (apt.pack("request_info", 0x11), oracle.hw_req_info(0x11, 1)),
    (apt.pack("stop_updates", BAY), oracle.hw_stop_updatemsgs(BAY, 1)),
    (apt.pack("request_bay", 0x11, bay=2), oracle.rack_req_bayused(0x11, 1, 2)),
    (apt.pack("set_enabled", BAY, state=1), oracle.mod_set_chanenablestate(BAY, 1, 1, 1)),
    (
        apt.pack("set_velocity", BAY, minimum=0, acceleration=27_488, velocity=33_554_432),
        oracle.mot_set_velparams(BAY, 1, 1, 0, 27_488, 33_554_432),
    ),
    (apt.pack("request_velocity", BAY), oracle.mot_req_velparams(BAY, 1, 1)),
    (
        apt.pack("set_home", BAY, direction=2, limit=1, velocity=1_342_177, offset=-5),
        oracle.mot_set_homeparams(BAY, 1, 1, 2, 1, 1_342_177, -5),
    ),
    (apt.pack("home", BAY), oracle.mot_move_home(BAY, 1, 1)),
    (
        apt.pack("move_absolute", BAY, position=-4_400_000),
        oracle.mot_move_absolute(BAY, 1, 1, -4_400_000),
    ),
    (apt.pack("stop", BAY, mode=2), oracle.mot_move_stop(BAY, 1, 1, 2)),
    (apt.pack("resume_end_of_move", BAY), oracle.mot_resume_endofmovemsges(BAY, 1)),
    (apt.pack("request_status", BAY), oracle.mot_req_dcstatusupdate(BAY, 1, 1)),
    (apt.pack("keep_alive", BAY), oracle.mot_ack_dcstatusupdate(BAY, 1)),
    (apt.pack("request_axis", BAY), oracle.mot_req_stageaxisparams(BAY, 1, 1)),
    (
        apt.pack("set_profile_mode", BAY, mode=0, jerk=100),
        oracle.mot_set_profilemodeparams(BAY, 1, 1, 0, 100),
    ),
    (apt.pack("request_ports", 0x50), oracle.mot_req_kcubetrigconfig(0x50, 1, 1)),
    (apt.pack("request_pulses", 0x50), oracle.mot_req_kcubeposttrigparams(0x50, 1, 1)),
]


@pytest.mark.parametrize(("ours", "theirs"), PACKED, ids=[ours[:2].hex() for ours, _ in PACKED])
def test_frames_are_those_of_the_oracle(ours: bytes, theirs: bytes) -> None:
    assert ours.hex(" ") == theirs.hex(" ")


def test_frames_of_the_manual() -> None:
    scale = apt.Scale()
    speed, acceleration = scale.velocity(100.0), scale.acceleration(1000.0)
    values = {"minimum": 0, "acceleration": acceleration, "velocity": speed}
    velocity = apt.pack("set_velocity", apt.bay_address(2), **values)
    assert velocity.hex(" ") == "13 04 0e 00 a2 01 01 00 00 00 00 00 b0 35 00 00 cd cc cc 00"
    assert apt.pack("keep_alive", BAY) == bytes.fromhex("920400002101")
    assert scale.velocity(25.0) == struct.unpack("<i", bytes.fromhex("33333300"))[0]
    assert scale.velocity(200.0) == 26_843_546
    assert scale.acceleration(2000.0) == 27_488
    assert scale.position(220.0) == 4.4e6


def test_trigger_frames_of_the_manufacturers_example() -> None:
    """The oracle's are 12 bytes shorter than those that Thorlabs sends a KBD101."""
    ports = apt.pack("set_ports", 0x50, mode_1=2, polarity_1=1, mode_2=0x0B, polarity_2=1)
    assert ports == bytes.fromhex("23051600d001 0100 0200 0100 0b00 0100") + bytes(12)
    pulses = {
        "start_forward": 0,
        "interval_forward": 0,
        "count_forward": 1,
        "start_reverse": 0,
        "interval_reverse": 0,
        "count_reverse": 1,
        "width_us": 50,
        "cycles": 1,
    }
    assert apt.pack("set_pulses", 0x50, **pulses) == bytes.fromhex(
        "26052e00d001 0100 00000000 00000000 01000000 00000000 00000000 01000000 32000000 01000000"
    ) + bytes(12)


def frame(id: int, payload: bytes, source: int = BAY) -> bytes:
    return struct.pack("<HHBB", id, len(payload), 0x81, source) + payload


def both(data: bytes) -> tuple[apt.Frame, Any]:
    """What the package and the oracle read."""
    (theirs,) = oracle.Unpacker(io.BytesIO(data))
    return apt.parse(data), theirs


INCOMING = [
    (0x0491, struct.pack("<HihHI", 1, -123_456, -205, 3, 0x8000_2410)),
    (0x0464, struct.pack("<HihHI", 1, 4_400_000, 0, 3, 0x8000_2400)),
    (0x0466, struct.pack("<HihHI", 1, 5, 0, 3, 0x8000_2400)),
    (0x0415, struct.pack("<H3i", 1, 0, 13_744, 13_421_773)),
    (0x0528, struct.pack("<H8i", 1, *PULSES.values())),
]


@pytest.mark.parametrize(("id", "payload"), INCOMING, ids=[hex(id) for id, _ in INCOMING])
def test_fields_are_those_of_the_oracle(id: int, payload: bytes) -> None:
    ours, theirs = both(frame(id, payload))
    values = list(theirs._asdict().values())
    assert ours.source == BAY
    for field, value in ours.values.items():
        if field not in ("bits", "current"):
            assert value in values, field
    if "bits" in ours.values:
        oracles = {"enabled": "channel_enabled", "position_error": "motion_error"}
        decoded = apt.decode_bits(ours.integer("bits"))
        for name in ("homed", "settled", "enabled", "moving_forward", "position_error"):
            assert (name in decoded) == bool(getattr(theirs, oracles.get(name, name))), name


@pytest.mark.parametrize("reserved_words", [1, 4])
def test_answers_about_a_racks_trigger_have_either_length(reserved_words: int) -> None:
    """The manual has four reserved words, a published driver sends one."""
    values = struct.pack("<6H8i", 2, 0, 1, 0, 0x0D, 1, *PULSES.values())
    data = frame(0x0262, values + bytes(2 * reserved_words))
    assert apt.frame_bytes(data[:6]) == len(data)
    answer = apt.parse(data)
    assert {name: answer.integer(name) for name in PULSES} == PULSES


def test_axis_data_of_the_manual() -> None:
    values = (1, 0, 0, b"MLS203", 94_000_001, 20_000, 0, 1_500_000, 27_488, 27_488, 26_843_546)
    ours, theirs = both(frame(0x04F2, struct.pack("<3H16s2I5i24x", *values)))
    assert ours.integer("counts_per_unit") == theirs.counts_per_unit == 20_000
    assert ours.integer("maximum") == theirs.max_pos == 1_500_000
    assert ours.integer("velocity") == theirs.max_vel
    assert ours.text("part") == "MLS203"


def test_every_status_bit_has_one_name() -> None:
    assert sum(apt.STATUS_BITS) == 0xFFFF_FFFF
    assert len(set(apt.STATUS_BITS.values())) == 32
    assert apt.decode_bits(0x401) == ("forward_hard_limit", "homed")
