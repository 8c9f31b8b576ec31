"""A model behind a pseudo-terminal, as pyserial sees it."""

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
        self.resting = False
        self.received = b""
        self._answer = b""

    def feed(self, data: bytes) -> None:
        self.received += data
        self._answer += data

    def step(self) -> bytes:
        answer, self._answer = self._answer, b""
        return answer


@pytest.fixture
def link(tmp_path: Path) -> Path:
    return tmp_path / "port"


def read(port: serial.Serial, size: int) -> bytes:
    port.timeout = DEADLINE_S
    return port.read(size)


def test_every_byte_passes_both_ways(link: Path) -> None:
    with PtyPort(Echo(), link), serial.Serial(str(link)) as port:
        for _ in range(3):
            port.write(EVERY_BYTE)
            assert read(port, 256) == EVERY_BYTE
    assert not link.is_symlink()


def test_it_can_be_opened_again(link: Path) -> None:
    with PtyPort(Echo(), link):
        for _ in range(2):
            with serial.Serial(str(link), exclusive=True) as port:
                port.write(b"\x11\x0d\x03")
                assert read(port, 3) == b"\x11\x0d\x03"


def test_an_unplugged_model_hangs_up_and_returns(link: Path) -> None:
    model = Echo()
    with PtyPort(model, link):
        with serial.Serial(str(link), timeout=DEADLINE_S) as port:
            model.gone = True
            with pytest.raises((serial.SerialException, OSError)):
                port.read(1)
        wait_until(lambda: not link.exists(), "the port's end")
        model.gone = False
        wait_until(link.exists, "the port again")
        with serial.Serial(str(link)) as port:
            port.write(b"again")
            assert read(port, 5) == b"again"


def test_a_host_that_does_not_read_blocks_nothing(link: Path) -> None:
    model = Echo()
    with PtyPort(model, link), serial.Serial(str(link)) as port:
        for _ in range(100):
            port.write(bytes(1000))
        wait_until(lambda: len(model.received) == 100_000, "all bytes")


def test_a_link_that_cannot_be_made_is_one_line(link: Path) -> None:
    with pytest.raises(DeviceError, match="choose another folder"):
        PtyPort(Echo(), link / "missing")
