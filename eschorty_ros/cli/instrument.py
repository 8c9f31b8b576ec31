"""The modules of the nodes, and an orderly end by signals, for the commands."""

from __future__ import annotations

import contextlib
import importlib
import signal
import sys
from collections.abc import Iterator
from types import ModuleType
from typing import NoReturn

from eschorty_ros.core.base.errors import EschortyError


def nodes_module(name: str, make: str) -> ModuleType:
    """Return a module of ``nodes``; EschortyError without ROS 2.

    ``make`` is the Makefile's target that does the same with all set-up.
    """
    try:
        return importlib.import_module(f"eschorty_ros.nodes.{name}")
    except ImportError as error:
        raise EschortyError(
            f"ROS 2 is not ready ({error}); run `make {make}`, or source a ROS 2 installation in "
            "which this package is built; `eschorty simulate` needs no ROS"
        ) from error


@contextlib.contextmanager
def ended_by_signals() -> Iterator[None]:
    """Make SIGTERM and SIGINT raise, so that every clean-up runs and the laser is disabled.

    A shell starts a background job with SIGINT ignored.
    """
    handlers = {signal.SIGTERM: _terminated, signal.SIGINT: signal.default_int_handler}
    previous = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _terminated(*_: object) -> NoReturn:
    sys.exit(128 + signal.SIGTERM)
