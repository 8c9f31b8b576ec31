"""The framer finds frames in a stream without checksum or sync byte."""

import random
import struct

import pytest

from eschorty_ros.hardware.stage.apt_framer import AptFramer

MS = 1_000_000


def status(position: int) -> bytes:
    return struct.pack("<HHBBHihHI", 0x0491, 14, 0x81, 0x50, 1, position, 0, 0, 0x8000_2400)


def positions(frames: list) -> list[int]:
    return [frame.integer("position") for frame in frames if frame.name == "status"]


def test_frames_in_any_pieces() -> None:
    data = b"".join(status(k) for k in range(50)) + b"\x44\x04\x01\x00\x01\x50"
    for size in (1, 3, 7, 19, 20, 1000):
        framer = AptFramer()
        frames = []
        for first in range(0, len(data), size):
            frames += framer.feed(data[first : first + size], 0)
        assert positions(frames) == list(range(50))
        assert frames[-1].name == "homed"
        assert framer.frames == 51
        assert framer.skipped_bytes == 0


@pytest.mark.fault("garbage between frames")
def test_garbage_between_frames_is_skipped() -> None:
    """driver: skips it byte by byte and counts; user reads: skipped_bytes in the diagnostics."""
    chance = random.Random(1)
    for _ in range(200):
        garbage = chance.randbytes(chance.randrange(1, 40))
        framer = AptFramer()
        frames = framer.feed(status(1) + garbage, 0)
        # Bytes that look like the start of a frame are dropped when nothing follows them.
        frames += framer.feed(status(2), 60 * MS) + framer.feed(status(3), 120 * MS)
        frames += framer.feed(b"", 200 * MS)
        assert positions(frames) == [1, 2, 3]
        assert framer.skipped_bytes == len(garbage)


def test_only_known_frames_for_the_host_pass() -> None:
    good = status(7)
    wrong = {
        "identifier": b"\x93" + good[1:],
        "length": good[:2] + b"\x0d" + good[3:],
        "destination": good[:4] + b"\x85" + good[5:],
        "source": good[:5] + b"\x33" + good[6:],
        "short form": good[:4] + b"\x01" + good[5:],
    }
    for what, data in wrong.items():
        framer = AptFramer()
        assert positions(framer.feed(data + good, 0)) == [7], what
        assert framer.skipped_bytes == len(data), what


@pytest.mark.fault("bytes lost")
def test_a_lost_byte_costs_two_frames_at_most() -> None:
    """driver: loses at most two frames for each; user reads: broken_frames in the diagnostics."""
    chance = random.Random(2)
    framer = AptFramer()
    kept = []
    cuts = 0
    for k in range(20_000):
        data = status(k)
        if chance.random() < 0.01:
            cut = chance.randrange(len(data))
            data = data[:cut] + data[cut + 1 :]
            cuts += 1
        kept += framer.feed(data, k * 20 * MS)
    right = set(range(20_000))
    assert len(right.intersection(positions(kept))) >= 20_000 - 2 * cuts


def test_an_incomplete_frame_is_dropped_after_50_ms() -> None:
    framer = AptFramer()
    assert framer.feed(status(1)[:12], 0) == []
    assert framer.feed(b"", 49 * MS) == []
    assert framer.broken_frames == 0
    assert framer.feed(b"", 51 * MS) == []
    assert framer.broken_frames == 1
    assert positions(framer.feed(status(2), 52 * MS)) == [2]


@pytest.mark.parametrize("reserved_bytes", [0, 12])
def test_answers_about_the_trigger_may_end_with_reserved_bytes(reserved_bytes: int) -> None:
    fields = struct.pack("<H8i", 1, 40_000, 40_000, 109, 4_360_000, 40_000, 109, 500, 1)
    size = len(fields) + reserved_bytes
    head = struct.pack("<HHBB", 0x0528, size, 0x81, 0x50)
    framer = AptFramer()
    answer, after = framer.feed(head + fields + bytes(reserved_bytes) + status(3), 0)
    assert answer.name == "pulses"
    assert answer.integer("start_reverse") == 4_360_000
    assert answer.integer("cycles") == 1
    assert positions([after]) == [3]
    cut = struct.pack("<HHBB", 0x0528, len(fields) - 1, 0x81, 0x50)
    assert framer.feed(cut + status(4), 0)[0].name == "status"
