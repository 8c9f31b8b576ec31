"""The choice between a device and its emulation, by the parameters ``driver`` and ``bench``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from eschorty_ros.core.base.errors import ArgumentError, DeviceGoneError, DeviceNotReadyError
from eschorty_ros.emulation.bench.folder import READY_FILE, bench_folder
from eschorty_ros.hardware.base.launcher import launched
from eschorty_ros.nodes.ros.parameters import Param

ClockNs = Callable[[], int]
Device = TypeVar("Device")

DRIVER = (
    Param("driver", "fake", "camera: evk4; laser: awg; stage: apt; "
          "fake: the real driver at an emulated bench"),
    Param("bench", "", "folder of that bench; empty: the user's in this ROS domain"),
)  # fmt: skip
REAL = {"camera": "evk4", "laser": "awg", "stage": "apt"}
"""Driver of a real device by node."""


def make(
    node: str,
    driver: Callable[[Mapping[str, Any], ClockNs], Device],
    at_bench: Callable[[Path], Mapping[str, Any]],
    parameters: Mapping[str, Any],
    clock_ns: ClockNs,
) -> Device:
    """Return the device that the parameter ``driver`` names.

    - ``node``: A name in ``REAL``.
    - ``driver``: Makes the device from the parameters.
    - ``at_bench``: Returns the parameters with which it uses the emulated bench in a folder.

    Raises ``ArgumentError`` for an unknown name. Raises ``DeviceGoneError`` when no bench runs in
    the folder. Raises ``DeviceNotReadyError`` when none runs yet: the launcher of this process
    starts one. Raises ``EschortyError`` when the driver refuses its parameters.
    """
    name = parameters["driver"]
    if name == "fake":
        folder = bench_folder(parameters["bench"])
        if not (folder / READY_FILE).exists():
            if launched():
                raise DeviceNotReadyError(f"the emulated bench in {folder} is not ready yet")
            raise DeviceGoneError(f"no emulated bench in {folder}; start eschorty-bench")
        parameters = {**parameters, **at_bench(folder)}
    elif name != REAL[node]:
        raise ArgumentError(f"driver {name!r} is unknown; choose one of fake, {REAL[node]}")
    return driver(parameters, clock_ns)
