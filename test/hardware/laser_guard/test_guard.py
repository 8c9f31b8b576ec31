"""The guard disables the output whatever happens to the process that enabled it."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from awg_process import AwgProcess, awg_process
from stall_clock import StallClock
from waiting import DEADLINE_S, wait_until

from eschorty_ros.core.base.errors import DeviceError, DeviceGoneError
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.hardware.base import stalls
from eschorty_ros.hardware.base.protocols import LaserOutput
from eschorty_ros.hardware.laser.awg_settings import GRANT_MAX_S
from eschorty_ros.hardware.laser.in_flight import VoidedError
from eschorty_ros.hardware.laser_guard import guard, guarded
from eschorty_ros.hardware.laser_guard.guarded import GuardedLaser
from eschorty_ros.hardware.laser_guard.messages import Wire
from eschorty_ros.hardware.laser_guard.opening import maker, open_again

OFF_LIMIT_S = 0.25
TIMEOUT_S = 0.5
# Where heartbeats are not the subject: a loaded machine may delay the owner.
LONG_S = 30.0
AWG = "eschorty_ros.hardware.laser.awg:open_laser"
SERVICE = "eschorty_ros.hardware.laser_guard.service"
INTERRUPTIBLE = "interruptible_awg:open_laser"
SQUARE = Modulation(70.0)
SUPPORT_FOLDER = str(Path(__file__).parents[2] / "support")


@pytest.fixture(autouse=True)
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", f"{SUPPORT_FOLDER}:{os.environ.get('PYTHONPATH', '')}")


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[AwgProcess]:
    with awg_process(tmp_path_factory.mktemp("generator")) as made:
        yield made


@pytest.fixture
def awg(shared: AwgProcess) -> Iterator[AwgProcess]:
    yield shared
    assert not shared.lit()


@contextlib.contextmanager
def opened(
    awg: AwgProcess, timeout_s: float = LONG_S, make: str = AWG, **settings: Any
) -> Iterator[GuardedLaser]:
    """A configured laser that is closed whatever the result of the test."""
    made = GuardedLaser(make, {"backend": awg.backend, **settings}, heartbeat_timeout_s=timeout_s)
    try:
        made.configure(SQUARE)
        yield made
    finally:
        with contextlib.suppress(DeviceError):
            made.close()
        _wait_for_end(made.guard_pid)


@pytest.fixture
def laser(awg: AwgProcess) -> Iterator[GuardedLaser]:
    with opened(awg) as made:
        yield made


def light(laser: GuardedLaser) -> None:
    laser.arm()
    laser.enable()


def test_output_follows_and_is_read_back(laser: GuardedLaser, awg: AwgProcess) -> None:
    assert laser.identity.serial == "AWG1234567890"
    laser.configure(Modulation(100.0, 0.25, "pulse"))
    light(laser)
    assert awg.lit()
    state = laser.readback()
    assert (state.output, state.modulation) == (LaserOutput.ON, Modulation(100.0, 0.25, "pulse"))
    laser.disable()
    laser.disable()
    assert not awg.lit()
    assert laser.readback().output is LaserOutput.OFF


def test_enable_needs_arming_each_time(laser: GuardedLaser, awg: AwgProcess) -> None:
    before = len(awg.outputs())
    for _ in range(2):
        with pytest.raises(DeviceError, match="not armed"):
            laser.enable()
        light(laser)
        laser.disable()
    assert awg.outputs()[before:] == ["ON", "OFF", "ON", "OFF"]


def test_close_switches_off_and_releases(awg: AwgProcess) -> None:
    with opened(awg) as laser:
        light(laser)
        laser.close()
        laser.close()
        assert not awg.lit()
    with opened(awg) as laser:
        laser.close()


def test_what_cannot_be_opened_is_one_line(laser: GuardedLaser, awg: AwgProcess) -> None:
    with pytest.raises(DeviceGoneError, match="no such device with serial 1"):
        GuardedLaser(AWG, {"backend": awg.backend, "serial": "1"})
    with pytest.raises(DeviceError, match="'nowhere:laser' cannot be loaded"):
        GuardedLaser("nowhere:laser", {})
    with pytest.raises(DeviceError, match="in use; close the other program"):
        GuardedLaser(AWG, {"backend": awg.backend})


OWNER = """
import ctypes, faulthandler, os, signal, subprocess, sys, time
for number in (signal.SIGHUP, signal.SIGTERM):
    signal.signal(number, signal.SIG_DFL)  # inherited as ignored under nohup
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.hardware.laser_guard.guarded import GuardedLaser
driver, backend, timeout_s, guard = sys.argv[1:]
laser = GuardedLaser(
    driver, {"backend": backend}, heartbeat_timeout_s=float(timeout_s), guard=guard
)
laser.configure(Modulation(70.0))
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
    raise RuntimeError("not caught")
elif way == "gil":
    # A library that never returns and keeps the interpreter to itself.
    ctypes.PyDLL(None).sleep(3)
elif way in ("child", "fork"):
    os.kill(os.getpid(), signal.SIGKILL)
time.sleep(30.0)
"""


class Owner:
    """A process that has enabled the output, until the end of a ``with``."""

    def __init__(
        self,
        awg: AwgProcess,
        stderr: int = subprocess.DEVNULL,
        timeout_s: float = LONG_S,
        guard: str = "",
    ) -> None:
        self.awg = awg
        self.process = subprocess.Popen(
            [
                sys.executable,
                "-c",
                OWNER,
                "guard_only_awg:open_laser",
                awg.backend,
                str(timeout_s),
                guard,
            ],
            start_new_session=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=stderr,
            text=True,
        )

    def __enter__(self) -> Owner:
        try:
            self.guard_pid = int(self.process.stdout.readline())
            assert self.awg.lit()
        except BaseException:
            self._kill()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._kill()
        _wait_for_end(self.guard_pid)

    def _kill(self) -> None:
        self.process.kill()
        self.process.wait()
        # A child of it may keep the other ends open.
        self.process.stdin.close()
        self.process.stdout.close()

    def die(self, way: str) -> float:
        """Seconds from the order until the output is off."""
        print(way, file=self.process.stdin, flush=True)
        return self.awg.off_after_s(int(self.process.stdout.readline()))

    def send(self, number: int) -> float:
        """Seconds from a signal to the process and its group until the output is off."""
        sent_ns = time.monotonic_ns()
        os.killpg(self.process.pid, number)
        return self.awg.off_after_s(sent_ns)


@pytest.fixture
def owner(awg: AwgProcess) -> Iterator[Owner]:
    with Owner(awg) as made:
        yield made


def check_off(took_s: float, limit_s: float = OFF_LIMIT_S) -> None:
    print(f"off after {took_s * 1e3:.1f} ms")
    assert took_s < limit_s


@pytest.mark.parametrize("way", ["abort", "segfault", "exit", "exception", "child", "fork"])
def test_off_when_the_owner_ends(owner: Owner, way: str) -> None:
    check_off(owner.die(way))
    _wait_for_end(owner.guard_pid)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGHUP, signal.SIGSTOP])
def test_off_when_the_owner_gets_a_signal(owner: Owner, number: int) -> None:
    check_off(owner.send(number))


@pytest.mark.parametrize("stopped", ["", "guard", "both"])
def test_light_ends_when_guard_and_owner_are_gone_together(owner: Owner, stopped: str) -> None:
    """Killed within 1 ms, the guard stopped before, or both stopped: a frozen container."""
    assert owner.awg.lit()
    sent_ns = time.monotonic_ns()
    os.kill(owner.guard_pid, signal.SIGSTOP if stopped else signal.SIGKILL)
    os.kill(owner.process.pid, signal.SIGSTOP if stopped == "both" else signal.SIGKILL)
    check_off(owner.awg.off_after_s(sent_ns), GRANT_MAX_S)
    with contextlib.suppress(ProcessLookupError):
        os.kill(owner.guard_pid, signal.SIGKILL)


def test_guard_renews_the_light(owner: Owner) -> None:
    time.sleep(4.0 * GRANT_MAX_S)
    # On a loaded machine a renewal may be late.
    wait_until(owner.awg.lit, "light")


def test_off_when_the_owner_hangs(awg: AwgProcess) -> None:
    with Owner(awg, timeout_s=TIMEOUT_S) as owner:
        check_off(owner.die("gil"), TIMEOUT_S + OFF_LIMIT_S)


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """The guard's service and its socket."""
    path = str(tmp_path / "guard.sock")
    process = subprocess.Popen(
        [sys.executable, "-m", SERVICE, path], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert path in process.stdout.readline()
    yield process, path
    process.terminate()
    assert process.wait() == 0
    process.stdout.close()


def test_guard_as_a_service_outlives_its_owners(
    awg: AwgProcess, served: tuple[subprocess.Popen[str], str]
) -> None:
    service, path = served
    # One owner after the other, as when the node's container is started again.
    for number in (signal.SIGKILL, signal.SIGSTOP):
        with Owner(awg, guard=path) as owner:
            check_off(owner.send(number))
    with contextlib.closing(GuardedLaser(AWG, {"backend": awg.backend}, guard=path)) as laser:
        laser.configure(SQUARE)
        light(laser)
        [guard_pid] = Path(f"/proc/{service.pid}/task/{service.pid}/children").read_text().split()
        sent_ns = time.monotonic_ns()
        os.kill(int(guard_pid), signal.SIGKILL)
        check_off(awg.off_after_s(sent_ns))
        with pytest.raises(DeviceGoneError, match="service is gone; output switched off"):
            laser.enable()
    second = subprocess.run([sys.executable, "-m", SERVICE, path], capture_output=True, text=True)
    assert (second.returncode, second.stderr.count("\n")) == (1, 1)
    assert "another guard serves it" in second.stderr


def test_guard_service_that_does_not_run_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(DeviceGoneError, match="start its service"):
        GuardedLaser(AWG, {}, guard=str(tmp_path / "guard.sock"))


def test_guard_has_a_session_and_the_kernels_protection_of_its_own(owner: Owner) -> None:
    pid = owner.guard_pid
    assert os.getsid(pid) == os.getpgid(pid) == pid
    permitted = subprocess.run(
        ["sh", "-c", "echo -1000 > /proc/self/oom_score_adj"], capture_output=True
    )
    adjusted = int(Path(f"/proc/{pid}/oom_score_adj").read_text())
    assert adjusted == (-1000 if permitted.returncode == 0 else adjusted)


def test_a_living_owner_is_not_reported_as_gone(
    owner: Owner, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Neither without descriptors to read its state, nor when it closes its end of the wire."""

    def exhausted(*_: object, **__: object) -> None:
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr("builtins.open", exhausted)
    assert stalls.process_fault(owner.process.pid) == ""
    monkeypatch.undo()
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    serving = guard.Guard(Wire(there), os.getpid())
    serving._lit.set()
    here.close()
    serving.run()
    there.close()
    assert f"process {os.getpid()} has closed its connection" in capfd.readouterr().err


def test_guard_ignores_the_terminals_signals(owner: Owner) -> None:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        os.kill(owner.guard_pid, number)
    time.sleep(0.2)
    assert owner.awg.lit()
    assert os.getsid(owner.guard_pid) == owner.guard_pid
    check_off(owner.send(signal.SIGKILL))


def test_full_standard_error_does_not_delay_the_guard(awg: AwgProcess) -> None:
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(writing, b"x" * 4096)
    os.set_blocking(writing, True)
    try:
        with Owner(awg, stderr=writing) as owner:
            for number in (signal.SIGSTOP, signal.SIGKILL):
                check_off(owner.send(number))
            _wait_for_end(owner.guard_pid)
    finally:
        os.close(reading)
        os.close(writing)


def test_guard_imports_nothing_from_the_current_folder(
    awg: AwgProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("json", "socket", "usb", "eschorty_ros"):
        (tmp_path / f"{module}.py").write_text("raise SystemExit('from the current folder')")
    monkeypatch.chdir(tmp_path)
    test_close_switches_off_and_releases(awg)


def test_guard_runs_the_package_that_started_it(
    awg: AwgProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also from a checkout that is no more than the current folder."""
    monkeypatch.setenv("PYTHONPATH", SUPPORT_FOLDER)
    test_close_switches_off_and_releases(awg)


def test_missing_heartbeats_disarm_until_armed_again(awg: AwgProcess) -> None:
    before = len(awg.outputs())
    with opened(awg, TIMEOUT_S) as laser:
        light(laser)
        began_ns = time.monotonic_ns()
        ctypes.PyDLL(None).sleep(2)
        check_off(awg.off_after_s(began_ns), TIMEOUT_S + OFF_LIMIT_S)
        state = laser.readback()
        assert state.output is LaserOutput.OFF
        assert "no heartbeat for 0.5 s" in state.reason
        with pytest.raises(DeviceError, match="arm it again"):
            laser.enable()
        light(laser)
        assert laser.readback().reason == ""
        laser.close()
        assert awg.outputs()[before:] == ["ON", "OFF", "ON", "OFF"]


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP, signal.SIGSEGV])
def test_off_when_the_guard_dies(laser: GuardedLaser, awg: AwgProcess, number: int) -> None:
    light(laser)
    sent_ns = time.monotonic_ns()
    os.kill(laser.guard_pid, number)
    check_off(awg.off_after_s(sent_ns))
    for call in (laser.arm, laser.enable, laser.readback):
        with pytest.raises(DeviceGoneError, match="output switched off; configure"):
            call()
    laser.disable()
    assert not awg.lit()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_closing_when_the_guard_has_just_died_switches_off(awg: AwgProcess, number: int) -> None:
    with opened(awg) as laser:
        light(laser)
        os.kill(laser.guard_pid, number)
        with contextlib.suppress(DeviceError):
            laser.close()
        assert not awg.lit()


@pytest.mark.fault("no answer, time-out")
def test_a_generator_that_hangs_does_not_keep_the_process_from_its_end(
    awg: AwgProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    """driver: waits 5 s at most; user reads: laser state unknown ... switch it off by hand"""
    answers = threading.Event()
    with ThreadPoolExecutor() as pool, opened(awg) as laser:
        light(laser)
        real = laser._open_directly
        monkeypatch.setattr(
            laser, "_open_directly", lambda: real() if answers.wait(3.0 * DEADLINE_S) else None
        )
        os.kill(laser.guard_pid, signal.SIGSTOP)
        try:
            for call in (laser.disable, laser.close):
                failure = pool.submit(call).exception(DEADLINE_S)
                assert "does not answer; treat the laser as on and switch" in str(failure)
        finally:
            answers.set()
        wait_until(lambda: not awg.lit(), "the output off once it answers")
        wait_until(
            lambda: (
                not {"laser guard", "laser off"} & {each.name for each in threading.enumerate()}
            ),
            "the generator released",
        )


def test_stall_of_the_guard_is_no_missing_heartbeat(
    awg: AwgProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = StallClock(monkeypatch)
    monkeypatch.setattr(guard, "time", clock)
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    wire = Wire(here)
    serving = threading.Thread(target=guard.Guard(Wire(there), os.getpid()).run)
    serving.start()
    try:
        given = {"settings": {"backend": awg.backend}, "heartbeat_timeout_s": TIMEOUT_S}
        wire.send({"id": 0, "do": "open", "make": AWG, **given})
        wire.send({"id": 1, "do": "configure", "modulation": {"frequency_hz": 70.0}})
        wire.send({"id": 2, "do": "arm"})
        wire.send({"id": 3, "do": "enable"})
        wait_until(awg.lit, "light")
        clock.advance(60.0)
        assert awg.lit()
        for _ in range(int(TIMEOUT_S / 0.05) + 2):
            clock.advance(0.05)
        wait_until(lambda: not awg.lit(), "the output off")
    finally:
        here.close()
        serving.join()
        there.close()


def test_guard_whose_driver_crashes(awg: AwgProcess) -> None:
    with opened(awg, make=INTERRUPTIBLE) as laser:
        light(laser)
        with pytest.raises(DeviceGoneError, match="exit code 7"):
            laser.readback()
        assert not awg.lit()
        laser.close()


def test_disabling_interrupts_a_read_back(awg: AwgProcess, tmp_path: Path) -> None:
    waits = tmp_path / "waits"
    with ThreadPoolExecutor() as pool, opened(awg, make=INTERRUPTIBLE, waits=str(waits)) as laser:
        light(laser)
        reading = pool.submit(laser.readback)
        wait_until(waits.exists, "the read-back in progress")
        asked_ns = time.monotonic_ns()
        laser.disable()
        check_off(awg.off_after_s(asked_ns))
        with pytest.raises(VoidedError, match="switched off meanwhile"):
            reading.result()


def test_an_answer_that_arrives_at_the_end_of_the_wait_counts(
    awg: AwgProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(guarded, "_LATE_S", DEADLINE_S)
    laser = GuardedLaser(
        AWG, {"backend": awg.backend}, heartbeat_timeout_s=LONG_S, answer_timeout_s=1e-9
    )
    with contextlib.closing(laser):
        laser.configure(SQUARE)
        light(laser)
        assert laser.readback().output is LaserOutput.ON


def test_commands_requested_before_disabling_are_void(
    awg: AwgProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    waits = tmp_path / "waits"
    with ThreadPoolExecutor() as pool, opened(awg, make=INTERRUPTIBLE, waits=str(waits)) as laser:
        light(laser)
        sent: list[str] = []
        send = laser._wire.send
        monkeypatch.setattr(
            laser._wire, "send", lambda message: (send(message), sent.append(message["do"]))
        )
        calls = [pool.submit(laser.readback)]
        wait_until(waits.exists, "the read-back in progress")
        calls += [pool.submit(laser.arm), pool.submit(laser.enable)]
        wait_until(lambda: {"arm", "enable"} <= set(sent), "both requested")
        laser.disable()
        assert all(isinstance(call.exception(), DeviceError) for call in calls)
        assert not awg.lit()


def test_mute_generator_is_unknown_and_the_guard_retries(
    awg: AwgProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A guard that is replaced for being slow does not retry.
    monkeypatch.setattr(guarded, "DISABLE_TIMEOUT_S", LONG_S)
    with opened(awg, light_grant=0.0) as laser:
        light(laser)
        awg.do("mute")
        with pytest.raises(DeviceError, match="laser state unknown"):
            laser.readback()
        with pytest.raises(DeviceError, match="laser state unknown"):
            laser.disable()
        with contextlib.suppress(DeviceError):
            laser.close()
        assert awg.lit()
        awg.do("speak")
        awg.off_after_s(time.monotonic_ns())


def test_renewal_that_fails_is_reported_and_retried(awg: AwgProcess) -> None:
    with opened(awg) as laser:
        light(laser)
        awg.do("mute")
        wait_until(lambda: not awg.lit(), "dark")

        def found() -> str:
            try:
                return laser.readback().output.name
            except DeviceError as error:
                return str(error)

        wait_until(lambda: found().startswith("laser state unknown"), "the failure")
        awg.do("speak")
        wait_until(lambda: found() == "OFF", "the output read back off")


def test_disabling_that_failed_without_light_is_retried_when_it_is_called_again(
    laser: GuardedLaser, awg: AwgProcess
) -> None:
    awg.do("mute")
    with pytest.raises(DeviceError, match="laser state unknown"):
        laser.disable()
    awg.do("speak")
    laser.disable()
    laser.configure(SQUARE)
    light(laser)
    assert awg.lit()


def test_another_generator_is_not_taken_for_the_lost_one(awg: AwgProcess) -> None:
    make = maker(AWG, {"backend": awg.backend})
    with pytest.raises(DeviceError, match="generator 41 is gone, AWG1234567890 is there"):
        open_again(make, "41")


def _wait_for_end(pid: int) -> None:
    def ended() -> bool:
        try:
            return "\nState:\tZ" in Path(f"/proc/{pid}/status").read_text()
        except (FileNotFoundError, ProcessLookupError):
            return True

    wait_until(ended, f"the end of {pid}")
