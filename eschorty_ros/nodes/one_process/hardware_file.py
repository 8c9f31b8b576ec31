"""The ROS parameter file of `eschorty scan --hardware`."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from typing import Any

from eschorty_ros.core.base.errors import ArgumentError, FormatError
from eschorty_ros.core.base.numbers import short
from eschorty_ros.core.base.yaml_file import read_yaml
from eschorty_ros.nodes.camera import node as camera
from eschorty_ros.nodes.laser import node as laser
from eschorty_ros.nodes.one_process.composition import NAMESPACE
from eschorty_ros.nodes.reconstruction import parameters as reconstruction
from eschorty_ros.nodes.replay import node as replay
from eschorty_ros.nodes.ros import lifecycle
from eschorty_ros.nodes.ros.drivers import REAL
from eschorty_ros.nodes.ros.parameters import check_name, of_ros
from eschorty_ros.nodes.scanner import node as scanner
from eschorty_ros.nodes.stage import node as stage
from eschorty_ros.nodes.viewer import node as viewer

_KEY = "ros__parameters"
TABLES = {
    "camera": camera.TABLE,
    "laser": laser.TABLE,
    "stage": stage.TABLE,
    "reconstruction": reconstruction.TABLE,
    "scanner": scanner.TABLE,
    "replay": replay.TABLE,
    "viewer": viewer.TABLE,
}


def read_hardware(path: str | os.PathLike[str]) -> dict[str, dict[str, Any]]:
    """Return parameters by node; the drivers of camera, laser and stage are real by default."""
    tables: dict[str, dict[str, Any]] = {name: {"driver": real} for name, real in REAL.items()}
    for name, values in read_parameters(path).items():
        tables.setdefault(name, {}).update(values)
    return tables


def read_parameters(path: str | os.PathLike[str]) -> dict[str, dict[str, Any]]:
    """Return parameters by node.

    The file has the format of launch files and ``--params-file``, with full node names:
    ``/eschorty/laser: {ros__parameters: {high_v: 3.3}}``.

    Raises ``FormatError`` when the file cannot be read, or has a node, a parameter or a value that
    does not exist.
    """
    document = read_yaml(path, FormatError)
    data = document.data or {}
    if not isinstance(data, dict):
        raise FormatError(f"{path}: it holds {short(data)}; write node names with their parameters")
    tables: dict[str, dict[str, Any]] = {}
    for full_name, table in data.items():
        where = document.at((full_name,))
        with _in_file(where):
            check_name(full_name, "node", [f"{NAMESPACE}/{name}" for name in TABLES])
        name = full_name.removeprefix(f"{NAMESPACE}/")
        values = table.get(_KEY) if isinstance(table, dict) and set(table) == {_KEY} else None
        if not isinstance(values, dict):
            raise FormatError(
                f"{where}: {full_name} is {short(table)}; write parameters under {_KEY} in it"
            )
        started = [lifecycle.AUTO_START] if name in REAL else []
        params = {param.name: param for param in (*TABLES[name], *started)}
        for parameter, value in values.items():
            if not of_ros(parameter):
                with _in_file(document.at((full_name, _KEY, parameter))):
                    check_name(parameter, f"parameter of {full_name}", list(params))
                    checked = params[parameter]
                    checked.check(checked.converted(value), f"{full_name}:")
        tables.setdefault(name, {}).update(values)
    return tables


@contextlib.contextmanager
def _in_file(where: str) -> Iterator[None]:
    try:
        yield
    except ArgumentError as error:
        raise FormatError(f"{where}: {error}") from error
