"""Control frames: requests, answers and refusals."""

import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.hardware.camera import treuzell
from eschorty_ros.hardware.camera.treuzell import Treuzell


class Link:
    """Returns prepared answers and records the requests."""

    def __init__(self, *answers: bytes) -> None:
        self.answers = list(answers)
        self.sent: list[bytes] = []
        self.recoveries = 0

    def send(self, frame: bytes) -> None:
        self.sent.append(frame)

    def receive(self) -> bytes:
        return self.answers.pop(0)

    def recover(self) -> None:
        self.recoveries += 1


def words(*values: int) -> bytes:
    return struct.pack(f"<{len(values)}I", *values)


def test_register_frames_are_those_of_the_protocol() -> None:
    read, write = words(0x10102, 12, 0, 0x14, 1), words(0x4001_0102, 12, 0, 0xB028, 0x3F0)
    link = Link(words(0x10102, 12, 0, 0x14, 0xA040_1806), write)
    control = Treuzell(link)
    assert control.read(0x14) == 0xA040_1806
    control.write(0xB028, 0x3F0)
    assert link.sent == [read, write]
    assert (control.requests, control.recoveries) == (2, 0)


def test_a_refused_request_is_an_error_at_once() -> None:
    link = Link(words(0x8000_0000, 0), words(0x8001_0102, 12, 0, 0x14, 22))
    control = Treuzell(link)
    with pytest.raises(DeviceError, match="request 55 is unknown"):
        control.request(0x55)
    with pytest.raises(DeviceError, match="request 10102 failed with errno 22"):
        control.read(0x14)
    assert link.recoveries == 0


REQUESTS = (treuzell.SERIAL, treuzell.REGISTERS, treuzell.REGISTERS | treuzell.WRITE)
FRAMES = st.builds(
    treuzell.request_frame,
    st.sampled_from([*REQUESTS, *(a | treuzell.FAILED for a in REQUESTS), treuzell.FAILED]),
    st.binary(max_size=40),
)


@settings(deadline=None)
@given(st.binary(max_size=64) | FRAMES, st.sampled_from(REQUESTS))
def test_any_bytes_are_an_answer_or_one_line(frame: bytes, request: int) -> None:
    if len(frame) >= 8 and frame[:8] == words(request, len(frame) - 8):
        assert treuzell.answer_payload(request, frame) == frame[8:]
        return
    with pytest.raises(DeviceError) as caught:
        treuzell.answer_payload(request, frame)
    assert "\n" not in str(caught.value)
