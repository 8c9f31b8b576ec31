"""When the camera's bytes leave as packets."""

import pytest

from eschorty_ros.live.packet_cutting import Packetizer

MS = 1_000_000


@pytest.mark.parametrize(
    ("size", "dark", "age_ms"),
    [(200, False, 20), (4000, False, 4), (200, True, 100), (1200, True, 100)],
)
def test_small_packets_wait_longer_and_those_of_a_dark_scene_longest(size, dark, age_ms):
    packetizer = Packetizer(4 * MS, 128_000, dark)
    sent = [
        (at_ms, stamp_ns, len(data))
        for at_ms in range(205)
        for stamp_ns, data in packetizer.push(bytes(size), at_ms * MS)
    ]
    assert sent[0] == (age_ms, 0, (age_ms + 1) * size)
    assert all(at_ms - stamp_ns / MS == age_ms for at_ms, stamp_ns, _ in sent)
    assert len(sent) == 205 // (age_ms + 1)


def test_a_packet_that_waits_in_the_dark_leaves_when_light_may_come():
    packetizer = Packetizer(4 * MS, 128_000, dark=True)
    assert not list(packetizer.push(bytes(200), 0))
    packetizer.dark = False
    assert [len(data) for _, data in packetizer.push(b"", 20 * MS)] == [200]


def test_a_packet_leaves_at_its_size_and_at_the_end():
    packetizer = Packetizer(4 * MS, 1000)
    assert [len(data) for _, data in packetizer.push(bytes(2500), 7)] == [1000, 1000]
    assert [(stamp_ns, len(data)) for stamp_ns, data in packetizer.flush()] == [(7, 500)]
    assert not list(packetizer.flush())
