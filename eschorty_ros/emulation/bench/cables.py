"""The other ends of a bench's cables, in a folder where drivers find them."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from eschorty_ros.emulation.bench.devices import Bench
from eschorty_ros.emulation.bench.folder import READY_FILE, STAGE_PORT, USB_SOCKET
from eschorty_ros.emulation.bus.pty_port import PtyPort
from eschorty_ros.emulation.bus.usb_server import UsbServer

_SWITCH_S = 5e-4


@contextlib.contextmanager
def serving(bench: Bench, folder: Path) -> Iterator[UsbServer]:
    """Serve a bench in an existing folder while inside.

    The file ``ready`` holds this process's id while everything is there.

    Raises
    ------
    DeviceError
        When socket or port cannot be made there.
    """
    ready = folder / READY_FILE
    with (
        UsbServer(folder / USB_SOCKET, bench.usb_devices) as usb,
        PtyPort(bench.stage, folder / STAGE_PORT, lock=bench.physics.lock),
        _short_turns(),
    ):
        try:
            ready.with_suffix(".new").write_text(f"{os.getpid()}\n")
            ready.with_suffix(".new").replace(ready)
            yield usb
        finally:
            ready.unlink(missing_ok=True)


@contextlib.contextmanager
def _short_turns() -> Iterator[None]:
    """Within it answers, short and urgent, come soon beside the simulation's long turns."""
    interval_s = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(interval_s)
