"""The modules of the nodes, for the commands."""

from __future__ import annotations

import importlib
from types import ModuleType

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
