"""Starting and ending a bench in its own process."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.emulation.bench.folder import READY_FILE

START_S = 300.0
"""The first start on a machine compiles kernels, for 20 s to some minutes."""

_END_S = 20.0
_POLL_S = 0.02


def bench_command(folder: Path, options: Mapping[str, object]) -> list[str]:
    """Return the command line of a bench with options of ``eschorty-bench``, without dashes."""
    command = [sys.executable, "-m", "eschorty_ros.emulation.bench.server", str(folder)]
    for name, value in options.items():
        command += [f"--{name}", str(value)]
    return command


@contextlib.contextmanager
def bench_process(folder: Path, options: Mapping[str, object]) -> Iterator[subprocess.Popen[str]]:
    """Run a bench in ``folder`` inside the context; it is ready on entry.

    Raises ``DeviceError`` when the bench does not start; with the message of the bench.
    """
    # A group of its own: Ctrl-C reaches the nodes only, which need their devices. No session of
    # its own: Linux may share the cores by sessions, which starved a bench for seconds.
    process = subprocess.Popen(
        bench_command(folder, options),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        process_group=0,
    )
    try:
        _wait_until_ready(process, folder)
        yield process
    finally:
        process.terminate()
        try:
            process.communicate(timeout=_END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()


def _ready(process: subprocess.Popen[str], folder: Path) -> bool:
    """Return whether the ready file in the folder is this bench's."""
    try:
        return (folder / READY_FILE).read_text().strip() == str(process.pid)
    except OSError:
        return False


def _wait_until_ready(process: subprocess.Popen[str], folder: Path) -> None:
    end_s = time.monotonic() + START_S
    while not _ready(process, folder):
        if process.poll() is not None:
            lines = process.communicate()[1].strip().splitlines()
            reason = lines[-1] if lines else f"exit code {process.returncode}"
            raise DeviceError(f"the bench ended: {reason.removeprefix('eschorty-bench: ')}")
        if time.monotonic() > end_s:
            raise DeviceError(f"the bench is not ready after {START_S:.0f} s; see {folder}")
        time.sleep(_POLL_S)
