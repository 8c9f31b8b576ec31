"""Names of a bench's socket and port, and the folder where drivers find them."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

USB_SOCKET = "usb.sock"
STAGE_PORT = "stage"
READY_FILE = "ready"


def bench_folder(name: str | Path | None) -> Path:
    """Return the folder ``name``; without one that of this user's bench in this ROS domain."""
    if name:
        return Path(name)
    base = os.environ.get("XDG_RUNTIME_DIR") or f"{tempfile.gettempdir()}/eschorty-{os.getuid()}"
    return Path(base) / f"eschorty-bench-{os.environ.get('ROS_DOMAIN_ID') or 0}"


def usb_spec(folder: Path) -> str:
    """Return the name of the bench's USB bus for ``hardware.base.usb.open_backend``."""
    return f"eschorty_ros.emulation.bus.usb_remote:backend?{folder / USB_SOCKET}"


def stage_port(folder: Path) -> str:
    """Return the serial port of the bench's stage."""
    return str(folder / STAGE_PORT)
