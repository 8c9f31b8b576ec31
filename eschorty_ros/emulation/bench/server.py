"""The command ``eschorty-bench``: the emulated bench as a process."""

from __future__ import annotations

import contextlib
import fcntl
import os
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import click

from eschorty_ros.core.base.errors import DeviceError, EschortyError
from eschorty_ros.emulation.bench.devices import Bench, BenchSettings
from eschorty_ros.emulation.bench.folder import (
    READY_FILE,
    STAGE_PORT,
    USB_SOCKET,
    bench_folder,
    stage_port,
    usb_spec,
)
from eschorty_ros.emulation.bench.physics import TRIGGERS, Imperfections
from eschorty_ros.emulation.bus import PtyPort, UsbServer
from eschorty_ros.hardware.base.launcher import end_with_launcher
from eschorty_ros.hardware.base.priority import DEVICE_NICE, raise_priority
from eschorty_ros.simulation.pixels import PRESETS

_LOCK_FILE = "lock"
_SWITCH_S = 5e-4
_POLL_S = 0.1
_CLIENTS_END_S = 3.0
_DEFAULTS = BenchSettings()


@contextlib.contextmanager
def serving(bench: Bench, folder: Path) -> Iterator[UsbServer]:
    """Serve a bench in an existing folder inside the context.

    The file ``ready`` holds this process's id while socket and port exist.

    Raises ``DeviceError`` when socket or port cannot be made there.
    """
    ready = folder / READY_FILE
    with (
        UsbServer(folder / USB_SOCKET, bench.usb_devices) as usb,
        PtyPort(bench.stage, folder / STAGE_PORT, lock=bench.physics.lock),
        _short_switch_interval(),
    ):
        try:
            ready.with_suffix(".new").write_text(f"{os.getpid()}\n")
            ready.with_suffix(".new").replace(ready)
            yield usb
        finally:
            ready.unlink(missing_ok=True)


@contextlib.contextmanager
def _short_switch_interval() -> Iterator[None]:
    """Switch threads often inside the context, so that answers do not wait for the simulation."""
    interval_s = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(interval_s)


class _Termination:
    """Ends the process at a signal: at once while it sets up, in order while it serves."""

    def __init__(self) -> None:
        # Read first: the parent may end while the bench is being made.
        self._parent = os.getppid()
        # A flag: a signal handler that sets an Event while it is waited for may deadlock.
        self._requested = False
        self._serving = False
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, self._request)

    def wait(self) -> None:
        """Wait for a signal or for the end of the parent process."""
        self._serving = True
        while not self._requested and os.getppid() == self._parent:
            time.sleep(_POLL_S)

    def _request(self, *_: object) -> None:
        self._requested = True
        if not self._serving:
            sys.exit(0)


def serve(folder: Path, settings: BenchSettings) -> None:
    """Serve a bench in ``folder`` until a signal or the end of the parent process.

    Raises ``EschortyError`` when the folder cannot be used, another bench uses it, or the settings
    are refused.
    """
    termination = _Termination()
    raise_priority(DEVICE_NICE)
    with _locked(folder):
        bench = Bench(settings)
        with serving(bench, folder) as usb:
            print(
                f"bench: {settings.scene}, {settings.calibration}; trigger {settings.trigger}; "
                f"USB {usb_spec(folder)}, stage {stage_port(folder)}",
                flush=True,
            )
            termination.wait()
            # Ctrl-C reaches the nodes, too, which need their devices while they end.
            end_s = time.monotonic() + _CLIENTS_END_S
            while usb.clients and time.monotonic() < end_s:
                time.sleep(_POLL_S)


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        lock = (folder / _LOCK_FILE).open("w")
    except OSError as error:
        raise DeviceError(
            f"bench folder {folder}: {error.strerror or error}; choose another"
        ) from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise DeviceError(
                f"bench folder {folder}: another bench uses it; end it or choose another folder"
            ) from error
        yield


@click.command(
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.argument("folder", required=False, type=click.Path(file_okay=False, path_type=Path))
@click.option("--scene", default=_DEFAULTS.scene, show_default=True,
              help="Scene before the camera: a name or a mesh file.")  # fmt: skip
@click.option("--calibration", default=_DEFAULTS.calibration, show_default=True,
              help="The actual optical build: a name in config/ or a file.")  # fmt: skip
@click.option("--pixels", type=click.Choice(tuple(PRESETS)), default=_DEFAULTS.pixels,
              show_default=True, help="Preset of the event pixels.")  # fmt: skip
@click.option("--effects", default=_DEFAULTS.effects, show_default=True, metavar="NAME=VALUE,...",
              help="Effects of the world, such as ambient=0.5,occlusion=1.")  # fmt: skip
@click.option("--seed", type=click.IntRange(0), default=_DEFAULTS.seed, show_default=True,
              help="Seed of pixels, noise, jitter and missing edges.")  # fmt: skip
@click.option("--background", type=click.FloatRange(0.0, 100.0), default=_DEFAULTS.background_hz,
              show_default=True, help="Background events of one pixel, Hz.")  # fmt: skip
@click.option("--trigger", type=click.Choice(TRIGGERS), default=_DEFAULTS.trigger,
              show_default=True, help="Source wired to the camera's trigger input.")  # fmt: skip
@click.option("--missing-edges", type=click.FloatRange(0.0, 1.0), default=0.0, show_default=True,
              help="Share of the trigger edges that the camera misses.")  # fmt: skip
@click.option("--sensor-ppm", type=float, default=0.0, show_default=True,
              help="Rate error of the camera's clock, ppm.")  # fmt: skip
@click.option("--generator-ppm", type=float, default=0.0, show_default=True,
              help="Rate error of the generator's clock, ppm.")  # fmt: skip
@click.option("--usb-jitter", type=click.FloatRange(0.0, 1000.0), default=0.0, show_default=True,
              help="Largest delay of the camera's bytes, ms.")  # fmt: skip
@click.option("--laser-log", type=click.Path(dir_okay=False, path_type=Path),
              help="File for a line '<ns> ON|OFF' per change of the laser output, "
              "CLOCK_MONOTONIC.")  # fmt: skip
def command(
    folder: Path | None,
    scene: str,
    calibration: str,
    pixels: str,
    effects: str,
    seed: int,
    background: float,
    trigger: str,
    missing_edges: float,
    sensor_ppm: float,
    generator_ppm: float,
    usb_jitter: float,
    laser_log: Path | None,
) -> None:
    """Emulate camera, generator and stage at the level of USB transfers and serial bytes.

    FOLDER gets a Unix socket for the USB bus (usb.sock), a serial port of the stage (stage) and,
    when both exist, the file ready. Without FOLDER it is the one that nodes with driver
    "fake" use: one for each user and ROS_DOMAIN_ID.

    The drivers on it are those of the real devices. It ends with Ctrl-C, SIGTERM, or with the
    process that started it; connected clients get 3 s to close.

    \b
    Examples:
      eschorty-bench                              # then: ros2 run eschorty_ros camera, ...
      eschorty-bench --scene sphere --trigger laser
      eschorty-bench /tmp/bench --sensor-ppm 50 --usb-jitter 3 --missing-edges 0.001
    """  # noqa: D301
    serve(
        bench_folder(folder),
        BenchSettings(
            scene,
            calibration,
            pixels,
            seed,
            background,
            trigger,
            Imperfections(sensor_ppm, generator_ppm, usb_jitter, missing_edges, seed),
            str(laser_log or ""),
            effects,
        ),
    )


def main() -> int:
    """Entry point; a stated failure is one line and exit code 1."""
    end_with_launcher()
    try:
        command(prog_name="eschorty-bench", standalone_mode=True)
    except EschortyError as error:
        print(f"eschorty-bench: {' '.join(str(error).split())}", file=sys.stderr, flush=True)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
