"""The driver with its threads, on a pseudo-terminal in real time."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from eschorty_ros.core.errors import DeviceError, DeviceGoneError
from eschorty_ros.emulation.apt_model import AptModel
from eschorty_ros.emulation.pty_port import PtyPort
from eschorty_ros.hardware.stage import apt_port
from eschorty_ros.hardware.stage.apt_open import open_stage
from eschorty_ros.hardware.stage.apt_setup import AptSettings
from eschorty_ros.hardware.stage.apt_stage import AptStage

DEADLINE_S = 20.0


def wait(condition: object) -> None:
    end_s = time.monotonic() + DEADLINE_S
    while not condition():  # type: ignore[operator]
        assert time.monotonic() < end_s
        time.sleep(0.01)


@pytest.fixture
def model() -> AptModel:
    return AptModel(time.time_ns, power_up_mm=1.0)


@pytest.fixture
def port(model: AptModel, tmp_path: Path) -> Iterator[str]:
    link = tmp_path / "stage"
    with PtyPort(model, link):
        yield str(link)


def opened(port: str) -> AptStage:
    return open_stage(AptSettings(homing_mm_s=25.0), time.time_ns, port)


def test_home_move_stop_and_close(port: str, model: AptModel) -> None:
    stage = opened(port)
    try:
        stage.home()
        wait(lambda: stage.state().homed and not stage.state().moving)
        stage.move_to(40.0, 200.0)
        wait(lambda: not stage.state().moving)
        assert stage.state().position_mm == pytest.approx(40.0, abs=1e-4)
        stage.move_to(200.0, 50.0)
        time.sleep(0.3)
        stage.stop()
        wait(lambda: not stage.state().moving)
        assert stage.state().position_mm < 80.0
        assert stage.healthy
    finally:
        stage.close()


def test_fault_x2_second_client(port: str) -> None:
    """driver: the port is opened exclusively; user reads: another program holds ...; close it."""
    stage = opened(port)
    try:
        with pytest.raises(DeviceError, match=r"another program holds .*stage; close it"):
            opened(port)
    finally:
        stage.close()


def test_fault_s6_unplug_on_the_port(port: str, model: AptModel) -> None:
    """driver: its threads end, orders fail; user reads: the stage's port failed; check cable."""
    stage = opened(port)
    model.gone = True
    wait(lambda: not stage.healthy)
    with pytest.raises(DeviceGoneError, match="port failed"):
        stage.state()
    stage.stop()
    stage.close()
    assert not [t for t in stage._link._threads if t.is_alive()]
    with pytest.raises(DeviceGoneError, match="no port"):
        opened(port)
    model.gone = False
    wait(lambda: Path(port).exists())
    opened(port).close()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
@pytest.mark.parametrize("thread", ["apt reader", "apt writer"])
def test_a_thread_that_ends_by_a_mistake_stops_the_stage(
    port: str, model: AptModel, thread: str
) -> None:
    stage = opened(port)

    def mistake(*_: object) -> None:
        assert threading.current_thread().name == thread
        raise ZeroDivisionError("nobody thought of it")

    try:
        stage.home()
        wait(lambda: stage.state().homed and not stage.state().moving)
        stage.move_to(200.0, 50.0)
        wait(lambda: model.axis.moving(time.time_ns()))
        if thread == "apt reader":
            stage._tracker.hear = mistake  # type: ignore[method-assign]
        else:
            stage._link.every(1.0, mistake)
        wait(lambda: not stage.healthy)
        for call in (stage.state, stage.home, lambda: stage.move_to(10.0, 10.0)):
            with pytest.raises(DeviceError, match=r"driver failed: Zero.*nobody thought of it.*;"):
                call()
        wait(lambda: not model.axis.moving(time.time_ns()))
        assert model.axis.position_mm(time.time_ns()) < 150.0
    finally:
        stage.close()
    assert not [t for t in stage._link._threads if t.is_alive()]


def test_fault_s9_blocked_callback(port: str, model: AptModel) -> None:
    """driver: keeps alive while whoever listens to it hangs; user reads: nothing."""
    stage = opened(port)
    heard: list[float] = []
    obey = model._obey

    def listening(name: str, address: int, values: dict[str, int], at_ns: int) -> None:
        if name == "keep_alive":
            heard.append(time.monotonic())
        obey(name, address, values, at_ns)

    model._obey = listening  # type: ignore[method-assign]
    release = threading.Event()

    def hang() -> None:
        with stage._lock:
            release.wait(2.5)

    try:
        blocker = threading.Thread(target=hang)
        blocker.start()
        begun_s = time.monotonic()
        wait(lambda: sum(at > begun_s for at in heard) >= 4)
        release.set()
        blocker.join()
        wait(lambda: stage.healthy)
    finally:
        release.set()
        stage.close()


def test_ports_are_found_by_serial_number(monkeypatch: pytest.MonkeyPatch) -> None:
    class Info:
        def __init__(self, device: str, serial_number: str | None) -> None:
            self.device, self.serial_number = device, serial_number

    there = [Info("/dev/ttyS0", None), Info("/dev/ttyUSB3", "28250001"), Info("/dev/ttyUSB4", "A1")]
    monkeypatch.setattr(apt_port.list_ports, "comports", lambda: there)
    assert apt_port.find_port("kbd101") == "/dev/ttyUSB3"
    assert apt_port.find_port("kbd101", "A1") == "/dev/ttyUSB4"
    with pytest.raises(DeviceGoneError, match=r"no serial port of a bbd30x; .*28250001"):
        apt_port.find_port("bbd30x")
    there.append(Info("/dev/ttyUSB5", "28250002"))
    with pytest.raises(DeviceError, match=r"2 controllers fit \(28250001, 28250002\); give serial"):
        apt_port.find_port("kbd101")
