"""Whatever happens to the process that wants light, its guard makes it dark."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import generator_double
import pytest
from generator_double import MAKE, Generator
from stall_clock import StallClock
from waiting import DEADLINE_S, wait_until

from eschorty_ros.core.base.errors import DeviceError, DeviceGoneError
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.hardware.base.protocols import LaserOutput
from eschorty_ros.hardware.laser_guard import guard, guarded
from eschorty_ros.hardware.laser_guard.guarded import GuardedLaser
from eschorty_ros.hardware.laser_guard.messages import Wire
from eschorty_ros.hardware.laser_guard.opening import maker, open_again

OFF_LIMIT_S = 0.25
TIMEOUT_S = 0.5
# Where silence is not the subject: a loaded machine may let the owner wait.
LONG_S = 30.0
TEST_FOLDER = str(Path(__file__).parents[2] / "support")


@pytest.fixture(autouse=True)
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    """The guard imports the double."""
    monkeypatch.setenv("PYTHONPATH", f"{TEST_FOLDER}:{os.environ.get('PYTHONPATH', '')}")


@pytest.fixture
def device(tmp_path: Path) -> Iterator[Generator]:
    with generator_double.generator(tmp_path) as made:
        yield made


@contextlib.contextmanager
def opened(device: Generator, timeout_s: float = LONG_S, **settings: str) -> Iterator[GuardedLaser]:
    """A laser that is closed whatever the test comes to."""
    made = GuardedLaser(MAKE, {**device.settings, **settings}, heartbeat_timeout_s=timeout_s)
    try:
        yield made
    finally:
        with contextlib.suppress(DeviceError):
            made.close()


@pytest.fixture
def laser(device: Generator) -> Iterator[GuardedLaser]:
    with opened(device) as made:
        yield made
    assert not device.lit()


def light(laser: GuardedLaser) -> None:
    laser.arm()
    laser.enable()


def test_output_follows_and_is_read_back(laser: GuardedLaser, device: Generator) -> None:
    assert laser.identity.serial == "42"
    laser.configure(Modulation(100.0, 0.25, "pulse"))
    light(laser)
    assert device.lit()
    state = laser.readback()
    assert (state.output, state.modulation) == (LaserOutput.ON, Modulation(100.0, 0.25, "pulse"))
    laser.disable()
    laser.disable()
    assert not device.lit()
    assert laser.readback().output is LaserOutput.OFF


def test_enable_needs_arming_each_time(laser: GuardedLaser, device: Generator) -> None:
    for _ in range(2):
        with pytest.raises(DeviceError, match="not armed"):
            laser.enable()
        light(laser)
        laser.disable()
    assert [output for _, output in device.lines()] == ["OFF", "ON", "OFF", "ON", "OFF"]


def test_close_switches_off_and_releases(device: Generator) -> None:
    with opened(device) as laser:
        light(laser)
        laser.close()
        laser.close()
        assert not device.lit()
    with opened(device) as laser:
        laser.close()


def test_generator_that_is_absent_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(DeviceGoneError, match="no generator"):
        GuardedLaser(MAKE, {"path": str(tmp_path / "nowhere")})


def test_driver_that_is_absent_is_one_line() -> None:
    with pytest.raises(DeviceError, match="'nowhere:laser' cannot be loaded"):
        GuardedLaser("nowhere:laser", {})


def test_second_client_is_refused(laser: GuardedLaser, device: Generator) -> None:
    with pytest.raises(DeviceError, match="busy"):
        GuardedLaser(MAKE, device.settings)


OWNER = """
import ctypes, faulthandler, os, signal, subprocess, sys, time
for number in (signal.SIGHUP, signal.SIGTERM):
    signal.signal(number, signal.SIG_DFL)  # inherited as ignored under nohup
from eschorty_ros.hardware.laser_guard.guarded import GuardedLaser
laser = GuardedLaser(
    "generator_double:GeneratorLaser", {"path": sys.argv[1]}, heartbeat_timeout_s=float(sys.argv[2])
)
laser.arm()
laser.enable()
print(laser.guard_pid, flush=True)
way = sys.stdin.readline().strip()
child = subprocess.Popen(["sleep", "2"], close_fds=False) if way == "child" else None
if way == "fork" and os.fork() == 0:
    time.sleep(2.0)
    os._exit(0)
print(time.monotonic_ns(), flush=True)
if way == "abort":
    os.abort()
elif way == "segfault":
    ctypes.string_at(0)
elif way == "exit":
    os._exit(3)
elif way == "exception":
    raise RuntimeError("nobody catches this")
elif way == "gil":
    # A library that never comes back and keeps the interpreter to itself.
    ctypes.PyDLL(None).sleep(3)
elif way in ("child", "fork"):
    os.kill(os.getpid(), signal.SIGKILL)
time.sleep(30.0)
"""


class Owner:
    """A process that has switched the light on."""

    def __init__(
        self,
        device: Generator,
        stderr: int = subprocess.DEVNULL,
        timeout_s: float = LONG_S,
    ) -> None:
        self.device = device
        self.process = subprocess.Popen(
            [sys.executable, "-c", OWNER, str(device.path), str(timeout_s)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=stderr,
            text=True,
        )
        try:
            self.guard_pid = int(self._line())
            assert "ON" in [output for _, output in device.lines()]
        except BaseException:
            self.close()
            raise

    def die(self, way: str) -> float:
        """Seconds from the order to darkness."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{way}\n")
        self.process.stdin.flush()
        return self.device.off_after_s(int(self._line()))

    def send(self, number: int) -> float:
        """Seconds from the signal to darkness."""
        sent_ns = time.monotonic_ns()
        self.process.send_signal(number)
        return self.device.off_after_s(sent_ns)

    def _line(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline()

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()


@pytest.fixture
def owner(device: Generator) -> Iterator[Owner]:
    made = Owner(device)
    yield made
    made.close()


@pytest.mark.parametrize("way", ["abort", "segfault", "exit", "exception", "child", "fork"])
def test_dark_when_the_owner_ends(owner: Owner, way: str) -> None:
    took_s = owner.die(way)
    print(f"{way}: dark after {took_s * 1e3:.1f} ms")
    assert took_s < OFF_LIMIT_S
    _wait_for_end(owner.guard_pid)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGHUP, signal.SIGSTOP])
def test_dark_when_the_owner_gets_a_signal(owner: Owner, number: int) -> None:
    took_s = owner.send(number)
    print(f"signal {number}: dark after {took_s * 1e3:.1f} ms")
    assert took_s < OFF_LIMIT_S


def test_dark_when_the_owner_hangs(device: Generator) -> None:
    owner = Owner(device, timeout_s=TIMEOUT_S)
    try:
        took_s = owner.die("gil")
    finally:
        owner.close()
    print(f"silent: dark after {took_s * 1e3:.1f} ms")
    assert took_s < TIMEOUT_S + OFF_LIMIT_S


def test_guard_is_deaf_to_the_terminal(owner: Owner) -> None:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        os.kill(owner.guard_pid, number)
    time.sleep(0.2)
    assert owner.device.lit()
    assert os.getsid(owner.guard_pid) == owner.guard_pid
    assert owner.send(signal.SIGKILL) < OFF_LIMIT_S


def test_nobody_reading_what_the_guard_says_keeps_it_from_nothing(device: Generator) -> None:
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(writing, b"x" * 4096)
    os.set_blocking(writing, True)
    owner = Owner(device, stderr=writing)
    try:
        for number in (signal.SIGSTOP, signal.SIGKILL):
            assert owner.send(number) < OFF_LIMIT_S
        _wait_for_end(owner.guard_pid)
    finally:
        os.close(reading)
        os.close(writing)
        owner.close()


def test_guard_imports_nothing_from_the_current_folder(
    device: Generator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("json", "socket", "generator_double", "eschorty_ros"):
        (tmp_path / f"{module}.py").write_text("raise SystemExit('from the current folder')")
    monkeypatch.chdir(tmp_path)
    test_close_switches_off_and_releases(device)


def test_guard_runs_the_package_that_started_it(
    device: Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also from a checkout that is no more than the current folder."""
    monkeypatch.setenv("PYTHONPATH", TEST_FOLDER)
    test_close_switches_off_and_releases(device)


def test_silence_disarms_until_armed_again(device: Generator) -> None:
    with opened(device, TIMEOUT_S) as laser:
        light(laser)
        began_ns = time.monotonic_ns()
        ctypes.PyDLL(None).sleep(2)
        assert device.off_after_s(began_ns) < TIMEOUT_S + OFF_LIMIT_S
        state = laser.readback()
        assert state.output is LaserOutput.OFF
        assert "no heartbeat for 0.5 s" in state.reason
        with pytest.raises(DeviceError, match="arm it again"):
            laser.enable()
        light(laser)
        assert laser.readback().reason == ""
        laser.close()
        assert [output for _, output in device.lines()] == ["OFF", "ON", "OFF", "ON", "OFF"]


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP, signal.SIGSEGV])
def test_dark_when_the_guard_dies(laser: GuardedLaser, device: Generator, number: int) -> None:
    light(laser)
    sent_ns = time.monotonic_ns()
    os.kill(laser.guard_pid, number)
    took_s = device.off_after_s(sent_ns)
    print(f"guard gets signal {number}: dark after {took_s * 1e3:.1f} ms")
    assert took_s < OFF_LIMIT_S
    for call in (laser.arm, laser.enable, laser.readback):
        with pytest.raises(DeviceGoneError, match="output switched off; configure"):
            call()
    laser.disable()
    assert not device.lit()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_closing_when_the_guard_has_just_died_is_dark(device: Generator, number: int) -> None:
    with opened(device) as laser:
        light(laser)
        os.kill(laser.guard_pid, number)
        with contextlib.suppress(DeviceError):
            laser.close()
        assert not device.lit()


def test_a_guard_that_stood_still_itself_calls_nobody_silent(
    device: Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = StallClock(monkeypatch)
    monkeypatch.setattr(guard, "time", clock)
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    wire = Wire(here)
    serving = threading.Thread(target=guard.Guard(Wire(there), os.getpid()).run)
    serving.start()
    try:
        wire.send({"id": 0, "do": "open", "make": MAKE, "settings": device.settings,
                   "heartbeat_timeout_s": TIMEOUT_S})  # fmt: skip
        for number, command in enumerate(("arm", "enable"), 1):
            wire.send({"id": number, "do": command})
        wait_until(device.lit, "light")
        clock.advance(60.0)
        assert device.lit()
        for _ in range(int(TIMEOUT_S / 0.05) + 2):
            clock.advance(0.05)
        assert not device.lit()
    finally:
        here.close()
        serving.join()
        there.close()


def test_guard_whose_driver_crashes(device: Generator) -> None:
    with opened(device, crash="readback") as laser:
        light(laser)
        with pytest.raises(DeviceGoneError, match="exit code 7"):
            laser.readback()
        assert not device.lit()
        laser.close()


def test_switching_off_overtakes(device: Generator, tmp_path: Path) -> None:
    """Reading back does not end here; nobody waits for it in the light."""
    held = tmp_path / "held"
    with opened(device, held=str(held)) as laser:
        light(laser)
        failures: list[Exception] = []
        reader = _thread(lambda: laser.readback(), failures)
        wait_until(held.exists, "the read-back under way")
        asked_ns = time.monotonic_ns()
        laser.disable()
        assert device.off_after_s(asked_ns) < OFF_LIMIT_S
        reader()
        assert "switched off meanwhile" in str(failures[0])
        laser.close()


def test_an_answer_that_comes_with_the_end_of_the_wait_counts(
    device: Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(guarded, "_LATE_S", DEADLINE_S)
    laser = GuardedLaser(MAKE, device.settings, heartbeat_timeout_s=LONG_S, answer_timeout_s=1e-9)
    with contextlib.closing(laser):
        light(laser)
        assert laser.readback().output is LaserOutput.ON


def test_what_was_asked_before_switching_off_is_void(
    device: Generator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    held = tmp_path / "held"
    with opened(device, held=str(held)) as laser:
        light(laser)
        asked: list[str] = []
        send = laser._wire.send
        monkeypatch.setattr(
            laser._wire, "send", lambda message: (send(message), asked.append(message["do"]))
        )
        failures: list[Exception] = []
        waits = [_thread(laser.readback, failures)]
        wait_until(held.exists, "the read-back under way")
        waits += [_thread(step, failures) for step in (laser.arm, laser.enable)]
        wait_until(lambda: {"arm", "enable"} <= set(asked), "both asked for")
        laser.disable()
        for wait in waits:
            wait()
        assert len(failures) == 3, failures
        assert not device.lit()
        laser.close()


def test_mute_generator_is_unknown_and_the_guard_insists(
    device: Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A guard that is replaced for being slow does not insist.
    monkeypatch.setattr(guarded, "DISABLE_TIMEOUT_S", LONG_S)
    with opened(device) as laser:
        light(laser)
        device.press("MUTE")
        with pytest.raises(DeviceError, match="gone"):
            laser.readback()
        with pytest.raises(DeviceGoneError):
            laser.disable()
        with contextlib.suppress(DeviceError):
            laser.close()
        assert device.lit()
        device.press("SPEAK")
        device.off_after_s(time.monotonic_ns())


def test_switching_off_is_tried_again_when_it_failed_in_the_dark(
    laser: GuardedLaser, device: Generator
) -> None:
    device.press("MUTE")
    with pytest.raises(DeviceError, match="gone"):
        laser.disable()
    device.press("SPEAK")
    laser.disable()
    light(laser)
    assert device.lit()


def test_another_generator_does_not_pass_for_the_lost_one(device: Generator) -> None:
    make = maker(MAKE, device.settings)
    with pytest.raises(DeviceError, match="generator 41 is gone, 42 is there; connect 41"):
        open_again(make, "41")


def _thread(step: Callable[[], object], failures: list[Exception]) -> Callable[[], None]:
    def attempt() -> None:
        try:
            step()
        except DeviceError as error:
            failures.append(error)

    thread = threading.Thread(target=attempt)
    thread.start()
    return thread.join


def _wait_for_end(pid: int) -> None:
    def ended() -> bool:
        try:
            return "\nState:\tZ" in Path(f"/proc/{pid}/status").read_text()
        except (FileNotFoundError, ProcessLookupError):
            return True

    wait_until(ended, f"the end of {pid}")
