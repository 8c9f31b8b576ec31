"""The bench as a process: where it is found, how it ends, what it refuses."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner
from short_folder import short_folder
from waiting import DEADLINE_S, wait_until

from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.emulation.bench.folder import (
    READY_FILE,
    STAGE_PORT,
    USB_SOCKET,
    bench_folder,
    usb_spec,
)
from eschorty_ros.emulation.bench.process import bench_command, bench_process
from eschorty_ros.emulation.bench.server import command
from eschorty_ros.hardware.base.usb import open_backend


@pytest.fixture
def folder() -> Iterator[Path]:
    with short_folder() as parent:
        yield parent / "bench"


def devices(folder: Path) -> list[tuple[int, int]]:
    backend = open_backend(usb_spec(folder))
    found = [backend.get_device_descriptor(device) for device in backend.enumerate_devices()]
    return sorted((one.idVendor, one.idProduct) for one in found)


def test_it_serves_all_devices_and_cleans_up(folder: Path, tmp_path: Path) -> None:
    log = tmp_path / "laser.log"
    with bench_process(folder, {"scene": "plane", "laser-log": log}) as process:
        assert devices(folder) == [(0x04B4, 0x00F5), (0x6656, 0x0834)]
        assert (folder / STAGE_PORT).resolve().is_char_device()
        assert int((folder / READY_FILE).read_text()) == process.pid
        assert log.read_text().split()[1::2] == ["OFF"]
        with pytest.raises(DeviceError, match="another bench uses it"), bench_process(folder, {}):
            pass
        assert devices(folder)
    assert process.returncode == 0
    left = {path.name for path in folder.iterdir()}
    assert not left & {READY_FILE, STAGE_PORT, USB_SOCKET}
    assert devices(folder) == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_it_without_output(folder: Path, number: int) -> None:
    process = subprocess.Popen(
        bench_command(folder, {}), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    try:
        wait_until((folder / READY_FILE).exists, "the bench ready")
        process.send_signal(number)
        _, errors = process.communicate(timeout=DEADLINE_S)
    finally:
        process.kill()
        process.communicate()
    assert process.returncode == 0
    assert errors == ""
    assert not (folder / READY_FILE).exists()


def test_it_ends_with_the_process_that_started_it(folder: Path) -> None:
    code = f"""
import subprocess, time
subprocess.Popen({bench_command(folder, {})!r}, stdout=subprocess.DEVNULL)
time.sleep(600)
"""
    parent = subprocess.Popen([sys.executable, "-c", code])
    try:
        wait_until((folder / READY_FILE).exists, "the bench ready")
        bench = int((folder / READY_FILE).read_text())
    finally:
        parent.send_signal(signal.SIGKILL)
        parent.wait()
    wait_until(lambda: not (folder / READY_FILE).exists(), "the bench ended")

    def gone() -> bool:
        try:
            return "Z" in Path(f"/proc/{bench}/stat").read_text().rsplit(")", 1)[1].split()[0]
        except (FileNotFoundError, ProcessLookupError):
            return True

    wait_until(gone, "its process gone")


@pytest.mark.parametrize(
    ("options", "named"),
    [({"scene": "teapot"}, "teapot"), ({"sensor-ppm": "2000"}, "sensor_ppm is 2000")],
)
def test_refused_options_are_one_line(folder: Path, options: dict[str, str], named: str) -> None:
    with pytest.raises(DeviceError, match=named) as refused, bench_process(folder, options):
        pass
    assert "\n" not in str(refused.value)


def test_the_default_folder_is_the_users_and_the_domains(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/7")
    monkeypatch.setenv("ROS_DOMAIN_ID", "12")
    assert bench_folder(None) == bench_folder("") == Path("/run/user/7/eschorty-bench-12")
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    monkeypatch.delenv("ROS_DOMAIN_ID")
    assert str(os.getuid()) in str(bench_folder(""))
    assert bench_folder("").name == "eschorty-bench-0"
    assert bench_folder("/tmp/b") == Path("/tmp/b")


def test_help_names_files_options_and_examples() -> None:
    done = CliRunner().invoke(command, ["--help"])
    assert done.exit_code == 0
    for word in ("FOLDER", "usb.sock", "--trigger", "Examples:", "Ctrl-C"):
        assert word in done.stdout
