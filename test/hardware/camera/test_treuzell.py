"""Control frames: what goes out, and what is not taken for an answer."""

from __future__ import annotations

import struct
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eschorty_ros.core.base.errors import DeviceError, DeviceStallError, DeviceTimeoutError
from eschorty_ros.hardware.camera import treuzell
from eschorty_ros.hardware.camera.treuzell import FrameError, Treuzell


class Board:
    """Answers requests from a dictionary of registers; answers can be spoilt one by one."""

    def __init__(self) -> None:
        self.registers: dict[int, int] = {0x14: 0xA040_1806}
        self.sent: list[bytes] = []
        self.recoveries = 0
        self.spoil: list[Callable[[bytes], bytes]] = []

    def send(self, frame: bytes) -> None:
        self.sent.append(frame)

    def receive(self) -> bytes:
        words = struct.unpack(f"<{len(self.sent[-1]) // 4}I", self.sent[-1])
        answer = self._answer(list(words))
        return self.spoil.pop(0)(answer) if self.spoil else answer

    def recover(self) -> None:
        self.recoveries += 1

    def _answer(self, words: list[int]) -> bytes:
        if words[0] == 0x10102:
            _, _, device, address, count = words
            values = [self.registers.get(address + 4 * i, 0) for i in range(count)]
            body = [device, address, *values]
        elif words[0] == 0x4001_0102:
            body = words[2:]
            self.registers[words[3]] = words[4]
        else:
            return struct.pack("<II", 0x8000_0000, 0)
        return struct.pack(f"<{2 + len(body)}I", words[0], 4 * len(body), *body)


def test_register_frames_are_those_of_the_protocol() -> None:
    board = Board()
    control = Treuzell(board)
    assert control.read(0x14) == 0xA040_1806
    control.write(0xB028, 0x3F0)
    assert board.sent == [
        struct.pack("<5I", 0x10102, 12, 0, 0x14, 1),
        struct.pack("<5I", 0x4001_0102, 12, 0, 0xB028, 0x3F0),
    ]
    assert board.registers[0xB028] == 0x3F0
    assert (control.requests, control.recoveries) == (2, 0)


def timed_out(_answer: bytes) -> bytes:
    raise DeviceTimeoutError("no answer")


def stalled(_answer: bytes) -> bytes:
    raise DeviceStallError("stalled")


SPOILT = {
    "short header": lambda answer: answer[:7],
    "empty": lambda _answer: b"",
    "size beyond the bytes": lambda answer: answer[:4] + b"\xff\x00\x00\x00" + answer[8:],
    "cut payload": lambda answer: answer[:-4],
    "other property": lambda answer: b"\x72\x00\x00\x00" + answer[4:],
    "stale answer of another register": lambda answer: answer[:12] + b"\x04\0\0\0" + answer[16:],
    "timed out": timed_out,
    "stalled": stalled,
}


@pytest.mark.parametrize("name", SPOILT)
def test_spoilt_answer_clears_the_link_and_is_asked_for_once_more(name: str) -> None:
    board = Board()
    control = Treuzell(board)
    board.spoil = [SPOILT[name]]
    assert control.read(0x14) == 0xA040_1806
    assert (board.recoveries, control.recoveries) == (1, 1)


@pytest.mark.parametrize("name", SPOILT)
def test_second_spoilt_answer_is_an_error(name: str) -> None:
    board = Board()
    control = Treuzell(board)
    board.spoil = [SPOILT[name]] * 2
    with pytest.raises((FrameError, DeviceTimeoutError, DeviceStallError)) as caught:
        control.read(0x14)
    assert "\n" not in str(caught.value)
    assert len(board.sent) == 2


def test_refusal_is_an_error_at_once() -> None:
    board = Board()
    control = Treuzell(board)
    with pytest.raises(DeviceError, match="request 55 is unknown"):
        control.request(0x55)
    refused = struct.pack("<5I", 0x8001_0102, 12, 0, 0x14, 22)
    board.spoil = [lambda _answer: refused]
    with pytest.raises(DeviceError, match="request 10102 failed with errno 22"):
        control.read(0x14)
    assert board.recoveries == 0


ASKED = (treuzell.SERIAL, treuzell.REGISTERS, treuzell.REGISTERS | treuzell.WRITE)
FRAMES = st.builds(
    treuzell.request_frame,
    st.sampled_from([*ASKED, *(a | treuzell.FAILED for a in ASKED), treuzell.FAILED]),
    st.binary(max_size=40),
)


@settings(deadline=None)
@given(st.binary(max_size=64) | FRAMES, st.sampled_from(ASKED))
def test_any_bytes_are_an_answer_or_one_line(frame: bytes, asked: int) -> None:
    if frame[:4] == asked.to_bytes(4, "little") and frame[4:8] == (len(frame) - 8).to_bytes(
        4, "little", signed=True
    ):
        assert treuzell.answer_payload(asked, frame) == frame[8:]
        return
    with pytest.raises(DeviceError) as caught:
        treuzell.answer_payload(asked, frame)
    assert "\n" not in str(caught.value)


def test_answer_payload_is_what_follows_the_header() -> None:
    frame = treuzell.request_frame(treuzell.SERIAL, b"\x34\x12\0\0\0\0\0\0")
    assert treuzell.answer_payload(treuzell.SERIAL, frame) == b"\x34\x12\0\0\0\0\0\0"
