"""The kernel's USBTMC file: on a pty with the operating system's calls, on a kernel in memory."""

from __future__ import annotations

import errno
import os
import threading
import tty
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

import pytest
from awg_bench import SQUARE, AwgBench

from eschorty_ros.core.errors import DeviceError, DeviceGoneError, DeviceTimeoutError
from eschorty_ros.emulation.awg_model import AwgModel
from eschorty_ros.hardware.laser import awg
from eschorty_ros.hardware.laser.awg import AwgLaser
from eschorty_ros.hardware.laser.awg_settings import AwgSettings
from eschorty_ros.hardware.laser.usbtmc_file import RawFile, UsbTmcFile
from eschorty_ros.hardware.protocols import LaserOutput

CLEAR, REPLY_ATTRIBUTES = 0x5B02, 0x80015B18


class KernelFile(RawFile):
    """``/dev/usbtmcN`` as the kernel driver serves it, over a generator model."""

    model: ClassVar[AwgModel]
    transfer_bytes: ClassVar[int] = 0
    failing: ClassVar[int] = 0
    closed: ClassVar[bool] = False

    def __init__(self, path: str) -> None:
        if path != "/dev/usbtmc0":
            raise FileNotFoundError(errno.ENOENT, "No such file or directory")
        self._left: deque[bytes] = deque()
        self._ended = True

    def write(self, data: bytes) -> int:
        self._fail()
        self.model._execute(data.decode())
        return len(data)

    def read(self, size: int) -> bytes:
        self._fail()
        if not self.model._replies:
            raise TimeoutError(errno.ETIMEDOUT, "Connection timed out")
        reply = self.model._replies.popleft()
        part = reply[: self.transfer_bytes or size]
        self._ended = part == reply
        if not self._ended:
            self.model._replies.appendleft(reply[len(part) :])
        return part

    def ioctl(self, request: int, argument: bytes) -> bytes:
        self._fail()
        if request == CLEAR:
            self.model._replies.clear()
        if request == REPLY_ATTRIBUTES:
            return bytes([self._ended])
        return argument

    def close(self) -> None:
        type(self).closed = True

    def _fail(self) -> None:
        if self.failing:
            raise OSError(self.failing, os.strerror(self.failing))


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> type[KernelFile]:
    class Kernel(KernelFile):
        model = AwgBench().model

    def opened(path: str, *, name: str, timeout_s: float) -> UsbTmcFile:
        return UsbTmcFile(path, name=name, timeout_s=timeout_s, opener=Kernel)

    monkeypatch.setattr(awg, "UsbTmcFile", opened)
    return Kernel


def laser() -> AwgLaser:
    return AwgLaser(AwgSettings(device="/dev/usbtmc0"))


@pytest.mark.parametrize("size", [0, 1, 5])
def test_laser_through_the_kernel(kernel: type[KernelFile], size: int) -> None:
    kernel.transfer_bytes = size
    opened = laser()
    opened.configure(SQUARE)
    opened.arm()
    opened.enable()
    assert kernel.model.lit
    opened.close()
    assert not kernel.model.output
    assert kernel.closed


def test_lost_reply_is_asked_for_again(kernel: type[KernelFile]) -> None:
    opened = laser()
    kernel.model._replies.append(b"late")
    assert opened.readback().output is LaserOutput.OFF
    assert opened.readback().counters["faults"] == 1


def test_another_generator_behind_the_same_file_is_refused(kernel: type[KernelFile]) -> None:
    wrong = AwgSettings(device="/dev/usbtmc0", serial="AWG0000000002")
    with pytest.raises(DeviceError, match="its serial is AWG1234567890, AWG0000000002 was"):
        AwgLaser(wrong)
    opened = laser()
    kernel.failing = errno.ENODEV
    with pytest.raises(DeviceError, match="laser state unknown"):
        opened.disable()
    kernel.failing = 0
    kernel.model = AwgModel(lambda: 0, serial="AWG0000000002", wait=lambda *_: False)
    opened.disable()
    with pytest.raises(DeviceError, match="its serial is AWG0000000002, AWG1234567890 was"):
        opened.configure(SQUARE)
    kernel.model = AwgModel(lambda: 0, wait=lambda *_: False)
    opened.configure(SQUARE)
    assert kernel.model.channels[0].frequency_hz == 70.0


@pytest.mark.parametrize(
    ("code", "kind", "text"),
    [
        (errno.ENODEV, DeviceGoneError, "the device is gone"),
        (errno.ETIMEDOUT, DeviceTimeoutError, "no answer in time"),
        (errno.EIO, DeviceError, "Input/output error; check the cable"),
    ],
)
def test_kernel_errors_are_one_line(
    kernel: type[KernelFile], code: int, kind: type[DeviceError], text: str
) -> None:
    link = UsbTmcFile("/dev/usbtmc0", name="generator", timeout_s=0.1, opener=kernel)
    kernel.failing = code
    for step in (lambda: link.write(b"X\n"), link.read, link.clear):
        with pytest.raises(kind, match=text) as caught:
            step()
        assert str(caught.value).startswith("generator at /dev/usbtmc0: ")


def test_missing_file_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(DeviceGoneError, match="no such device; check cable, power"):
        UsbTmcFile(str(tmp_path / "usbtmc7"), name="generator", timeout_s=0.1)


@pytest.fixture
def pty() -> Iterator[tuple[int, str]]:
    master, slave = os.openpty()
    tty.setraw(slave)
    yield master, os.ttyname(slave)
    os.close(slave)
    os.close(master)


def test_real_file_without_the_kernels_ioctls(pty: tuple[int, str]) -> None:
    master, path = pty
    link = UsbTmcFile(path, name="generator", timeout_s=0.1)
    answering = threading.Thread(
        target=lambda: (os.read(master, 100), os.write(master, b"70.5")), daemon=True
    )
    answering.start()
    with pytest.raises(DeviceError, match="in use; close the other program"):
        UsbTmcFile(path, name="generator", timeout_s=0.1)
    link.write(b":CHANnel1:BASE:FREQuency?\n")
    assert link.read() == b"70.5"
    answering.join()
    link.clear()
    link.reset()
    link.close()
    link.close()
