"""The ROS parameter file of `eschorty scan --hardware`."""

from __future__ import annotations

import os
from difflib import get_close_matches
from typing import Any

from eschorty_ros.core.base.errors import FormatError
from eschorty_ros.core.base.numbers import short
from eschorty_ros.core.base.yaml_file import read_yaml
from eschorty_ros.core.reconstruction import Settings
from eschorty_ros.nodes.camera import node as camera
from eschorty_ros.nodes.laser import node as laser
from eschorty_ros.nodes.reconstruction import parameters as reconstruction_parameters
from eschorty_ros.nodes.ros import lifecycle
from eschorty_ros.nodes.ros.drivers import REAL
from eschorty_ros.nodes.ros.parameters import from_settings
from eschorty_ros.nodes.scanner import node as scanner
from eschorty_ros.nodes.stage import node as stage

_NAMESPACE = "/eschorty/"
_KEY = "ros__parameters"
TABLES = {
    "camera": camera.TABLE,
    "laser": laser.TABLE,
    "stage": stage.TABLE,
    "reconstruction": (*reconstruction_parameters.TABLE, *from_settings(Settings, dynamic=True)),
    "scanner": scanner.TABLE,
}


def read_hardware(path: str | os.PathLike[str]) -> dict[str, dict[str, Any]]:
    """Return parameters by node; the drivers of camera, laser and stage are real by default.

    The file has the format of launch files and ``--params-file``, with full node names:
    ``/eschorty/laser: {ros__parameters: {high_v: 3.3}}``.

    Raises
    ------
    FormatError
        When the file cannot be read, or names a node or a parameter that does not exist.
    """
    document = read_yaml(path, FormatError)
    data = document.data or {}
    if not isinstance(data, dict):
        raise FormatError(f"{path}: it holds {short(data)}; write node names with their parameters")
    tables: dict[str, dict[str, Any]] = {name: {"driver": real} for name, real in REAL.items()}
    for full_name, table in data.items():
        where = document.at((full_name,))
        _known(where, "node", full_name, [f"{_NAMESPACE}{name}" for name in TABLES])
        name = full_name.removeprefix(_NAMESPACE)
        values = table.get(_KEY) if isinstance(table, dict) and set(table) == {_KEY} else None
        if not isinstance(values, dict):
            raise FormatError(
                f"{where}: {full_name} is {short(table)}; write parameters under {_KEY} in it"
            )
        names = [param.name for param in (*TABLES[name], lifecycle.AUTO_START)]
        for parameter in values:
            where = document.at((full_name, _KEY, parameter))
            _known(where, f"parameter of {full_name}", parameter, names)
        tables.setdefault(name, {}).update(values)
    return tables


def _known(where: str, what: str, name: object, names: list[str]) -> None:
    if name in names:
        return
    near = get_close_matches(str(name), names, n=1, cutoff=0.5)
    remedy = f"did you mean {near[0]}?" if near else f"choose one of {', '.join(names)}"
    raise FormatError(f"{where}: {short(name)} is no {what}; {remedy}")
