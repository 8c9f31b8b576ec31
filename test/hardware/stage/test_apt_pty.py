"""The driver with its threads, on a pseudo-terminal in real time."""

import contextlib
import os
import threading
import time
import tty
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import serial
from waiting import DEADLINE_S, wait_until

from eschorty_ros.core.base.errors import DeviceError, DeviceGoneError
from eschorty_ros.emulation.apt.model import AptModel
from eschorty_ros.emulation.bus import PtyPort
from eschorty_ros.hardware.stage import apt_port
from eschorty_ros.hardware.stage.apt_setup import AptSettings
from eschorty_ros.hardware.stage.apt_stage import AptStage, open_stage

# To the far end it takes longer than any wait of these tests.
SLOW_MM_S = 10.0


@pytest.fixture
def model() -> AptModel:
    return AptModel(time.monotonic_ns, power_up_mm=1.0)


@pytest.fixture
def port(model: AptModel, tmp_path: Path) -> Iterator[str]:
    link = tmp_path / "stage"
    with PtyPort(model, link):
        yield str(link)


def opened(port: str) -> contextlib.closing[AptStage]:
    """The driver on this port, closed at the end of a ``with``."""
    settings = AptSettings(homing_mm_s=25.0)
    return contextlib.closing(open_stage(settings, time.monotonic_ns, port, ""))


def homed(stage: AptStage) -> None:
    stage.home()
    wait_until(lambda: stage.state().homed and not stage.state().moving, "the reference")


def failed(stage: AptStage) -> bool:
    try:
        stage.state()
    except DeviceError:
        return True
    return False


def test_home_move_stop_and_close(port: str, model: AptModel) -> None:
    with opened(port) as stage:
        homed(stage)
        stage.move_to(40.0, 200.0)
        wait_until(lambda: not stage.state().moving, "rest")
        assert stage.state().position_mm == pytest.approx(40.0, abs=1e-4)
        stage.move_to(200.0, SLOW_MM_S)
        wait_until(lambda: stage.state().position_mm > 41.0, "motion")
        stage.stop()
        wait_until(lambda: not stage.state().moving, "rest")
        assert stage.state().position_mm < 199.0
        wait_until(lambda: stage.healthy, "fresh messages")


@pytest.mark.fault("two clients")
def test_a_second_client_is_refused(port: str) -> None:
    """driver: the port is opened exclusively; user reads: another program holds ...; close it."""
    refused = pytest.raises(DeviceError, match=r"another program holds .*stage; close it")
    with opened(port), refused:
        opened(port)


@pytest.mark.fault("serial line unplugged, no answer")
def test_an_unplugged_port_ends_the_threads(port: str, model: AptModel) -> None:
    """driver: its threads end, orders fail; user reads: the stage's port failed; check cable."""
    with opened(port) as stage:
        model.gone = True
        wait_until(lambda: failed(stage), "the failure")
        assert not stage.healthy
        with pytest.raises(DeviceGoneError, match="port failed"):
            stage.state()
        stage.stop()
    assert not [t for t in stage._link._threads if t.is_alive()]
    with pytest.raises(DeviceGoneError, match="no port"):
        opened(port)
    model.gone = False
    wait_until(Path(port).exists, "the port again")
    with opened(port):
        pass


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
@pytest.mark.parametrize("thread", ["apt reader", "apt writer"])
def test_a_thread_that_ends_by_an_error_stops_the_stage(
    port: str, model: AptModel, thread: str
) -> None:
    def broken(*_: object) -> None:
        assert threading.current_thread().name == thread
        raise ZeroDivisionError("unexpected")

    with opened(port) as stage:
        homed(stage)
        stage.move_to(200.0, SLOW_MM_S)
        wait_until(lambda: model.axis.moving(time.monotonic_ns()), "motion")
        if thread == "apt reader":
            stage._tracker.add_status = broken  # type: ignore[method-assign]
        else:
            stage._link.call_every(lambda: 1.0, broken)
        wait_until(lambda: failed(stage), "the failure")
        assert not stage.healthy
        for call in (stage.state, stage.home, lambda: stage.move_to(10.0, 10.0)):
            with pytest.raises(DeviceError, match=r"driver failed: Zero.*unexpected.*;"):
                call()
        wait_until(lambda: not model.axis.moving(time.monotonic_ns()), "rest")
        assert model.axis.position_mm(time.monotonic_ns()) < 150.0
    assert not [t for t in stage._link._threads if t.is_alive()]


@pytest.mark.fault("keep-alive missing")
def test_the_keep_alive_continues_while_a_caller_hangs(port: str, model: AptModel) -> None:
    """driver: sends it while another thread holds its lock; user reads: nothing."""
    received_s: list[float] = []
    handle, release = model._handle, threading.Event()

    def recording(name: str, *arguments: Any) -> None:
        if name == "keep_alive":
            received_s.append(time.monotonic())
        handle(name, *arguments)

    def hang() -> None:
        with stage._lock:
            release.wait(DEADLINE_S)

    with opened(port) as stage, ThreadPoolExecutor() as pool:
        model._handle = recording  # type: ignore[method-assign]
        pool.submit(hang)
        begun_s = time.monotonic()
        try:
            wait_until(lambda: sum(at > begun_s for at in received_s) >= 4, "four keep-alives")
        finally:
            release.set()
        wait_until(lambda: stage.healthy, "fresh messages")


def test_a_write_before_a_stall_of_the_host_is_no_failure(
    port: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(apt_port, "_WRITE_S", 0.2)
    write = os.write

    def stalls(descriptor: int, data: bytes) -> int:
        count = write(descriptor, data)
        time.sleep(0.4)
        return count

    with contextlib.closing(apt_port.open_port(port)) as opened_port:
        monkeypatch.setattr(os, "write", stalls)
        assert opened_port.write(b"\x92\x04\x00\x00\x21\x01") == 6


def test_a_port_that_takes_no_bytes_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(apt_port, "_WRITE_S", 0.2)
    host, device = os.openpty()
    tty.setraw(device)
    late = pytest.raises(serial.SerialTimeoutException, match="Write timeout")
    with contextlib.closing(apt_port.open_port(os.ttyname(device))) as opened_port, late:
        opened_port.write(bytes(100_000))
    os.close(host)
    os.close(device)


def test_ports_are_found_by_serial_number(monkeypatch: pytest.MonkeyPatch) -> None:
    def info(device: str, serial_number: str | None) -> SimpleNamespace:
        return SimpleNamespace(device=device, serial_number=serial_number)

    there = [info("/dev/ttyS0", None), info("/dev/ttyUSB3", "28250001"), info("/dev/ttyUSB4", "A1")]
    monkeypatch.setattr(apt_port.list_ports, "comports", lambda: there)
    assert apt_port.find_port("kbd101") == "/dev/ttyUSB3"
    assert apt_port.find_port("kbd101", "A1") == "/dev/ttyUSB4"
    with pytest.raises(DeviceGoneError, match=r"no serial port of a bbd30x; .*28250001"):
        apt_port.find_port("bbd30x")
    there.append(info("/dev/ttyUSB5", "28250002"))
    with pytest.raises(DeviceError, match=r"2 controllers fit \(28250001, 28250002\); give serial"):
        apt_port.find_port("kbd101")
