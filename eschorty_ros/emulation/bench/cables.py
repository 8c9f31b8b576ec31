"""Serving a bench's devices on a USB socket and a serial port."""

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
    """Serve a bench in an existing folder inside the context.

    The file ``ready`` holds this process's id while socket and port exist.

    Raises
    ------
    DeviceError
        When socket or port cannot be made there.
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
    """Let threads switch often inside the context: answers must not wait for the simulation."""
    interval_s = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(interval_s)
