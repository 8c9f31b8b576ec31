"""The choice between a device and its emulation, by the parameters ``driver`` and ``bench``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from eschorty_ros.core.base.errors import DeviceGoneError, DeviceNotReadyError
from eschorty_ros.emulation.bench.folder import READY_FILE, bench_folder
from eschorty_ros.hardware.base.launcher import launched
from eschorty_ros.nodes.ros.parameters import Param

ClockNs = Callable[[], int]
Device = TypeVar("Device")

REAL = {"camera": "evk4", "laser": "awg", "stage": "apt"}
"""Driver of a real device by node."""


def table(node: str) -> tuple[Param, ...]:
    """Return the parameters that choose between a node's real device and an emulated one."""
    real = REAL[node]
    return (
        Param(
            "driver",
            "fake",
            f"{real}: a real device; fake: the same driver at an emulated bench",
            choices=("fake", real),
        ),
        Param("bench", "", "folder of that bench; empty: the user's in this ROS domain"),
    )


def make(
    driver: Callable[[Mapping[str, Any], ClockNs], Device],
    at_bench: Callable[[Path], Mapping[str, Any]],
    parameters: Mapping[str, Any],
    clock_ns: ClockNs,
) -> Device:
    """Return the device that the parameter ``driver`` names.

    - ``driver``: Makes the device from the parameters.
    - ``at_bench``: Returns the parameters with which it uses the emulated bench in a folder.

    Raises ``DeviceGoneError`` when no bench runs in the folder. Raises ``DeviceNotReadyError`` when
    none runs yet: the launcher of this process starts one. Raises ``EschortyError`` when the driver
    refuses its parameters.
    """
    if parameters["driver"] == "fake":
        folder = bench_folder(parameters["bench"])
        if not (folder / READY_FILE).exists():
            if launched():
                raise DeviceNotReadyError(f"the emulated bench in {folder} is not ready yet")
            raise DeviceGoneError(f"no emulated bench in {folder}; start eschorty-bench")
        parameters = {**parameters, **at_bench(folder)}
    return driver(parameters, clock_ns)
