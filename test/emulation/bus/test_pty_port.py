"""A model behind a pseudo-terminal, as pyserial sees it."""

from __future__ import annotations

from pathlib import Path

import pytest
import serial
from waiting import DEADLINE_S, wait_until

from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.emulation.bus import PtyPort

EVERY_BYTE = bytes(range(256))


class Echo:
    """Answers with the bytes it receives."""

    def __init__(self) -> None:
        self.gone = False
        self.received = b""
        self._answer = b""

    def feed(self, data: bytes) -> None:
        self.received += data
        self._answer += data

    def step(self) -> bytes:
        answer, self._answer = self._answer, b""
        return answer


def read(port: serial.Serial, size: int) -> bytes:
    port.timeout = DEADLINE_S
    return port.read(size)


def test_every_byte_passes_both_ways(tmp_path: Path) -> None:
    with PtyPort(Echo(), tmp_path / "port"), serial.Serial(str(tmp_path / "port")) as port:
        for _ in range(3):
            port.write(EVERY_BYTE)
            assert read(port, 256) == EVERY_BYTE
    assert not (tmp_path / "port").is_symlink()


def test_it_can_be_opened_again(tmp_path: Path) -> None:
    with PtyPort(Echo(), tmp_path / "port"):
        for _ in range(2):
            with serial.Serial(str(tmp_path / "port"), exclusive=True) as port:
                port.write(b"\x11\x0d\x03")
                assert read(port, 3) == b"\x11\x0d\x03"


def test_an_unplugged_model_hangs_up_and_returns(tmp_path: Path) -> None:
    model = Echo()
    with PtyPort(model, tmp_path / "port"):
        with serial.Serial(str(tmp_path / "port"), timeout=DEADLINE_S) as port:
            model.gone = True
            with pytest.raises((serial.SerialException, OSError)):
                port.read(1)
        wait_until(lambda: not (tmp_path / "port").exists(), "the port's end")
        model.gone = False
        wait_until((tmp_path / "port").exists, "the port again")
        with serial.Serial(str(tmp_path / "port")) as port:
            port.write(b"again")
            assert read(port, 5) == b"again"


def test_a_host_that_does_not_read_blocks_nothing(tmp_path: Path) -> None:
    model = Echo()
    with PtyPort(model, tmp_path / "port"), serial.Serial(str(tmp_path / "port")) as port:
        for _ in range(100):
            port.write(bytes(1000))
        wait_until(lambda: len(model.received) == 100_000, "all bytes")


def test_a_link_that_cannot_be_made_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match="choose another folder"):
        PtyPort(Echo(), tmp_path / "missing" / "port")
