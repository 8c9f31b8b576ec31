"""A YAML file of node parameters for real devices: what `eschorty scan --hardware` reads."""

from __future__ import annotations

import os
from difflib import get_close_matches
from typing import Any

from eschorty_ros.core.errors import FormatError
from eschorty_ros.core.settings import Settings
from eschorty_ros.core.yaml_file import read_yaml
from eschorty_ros.nodes import camera, laser, lifecycle, reconstruction_parameters, scanner, stage
from eschorty_ros.nodes.drivers import REAL
from eschorty_ros.nodes.parameters import from_settings

_TABLES = {
    "camera": camera.TABLE,
    "laser": laser.TABLE,
    "stage": stage.TABLE,
    "reconstruction": (*reconstruction_parameters.TABLE, *from_settings(Settings)),
    "scanner": scanner.TABLE,
}


def read_hardware(path: str | os.PathLike[str]) -> dict[str, dict[str, Any]]:
    """Read parameters by node; camera, laser and stage get their real drivers unless told.

    Raises
    ------
    FormatError
        When the file cannot be read, or names a node or a parameter that does not exist.
    """
    data = read_yaml(path, FormatError) or {}
    if not isinstance(data, dict):
        raise FormatError(f"{path}: it holds {data!r}; write node names with their parameters")
    tables: dict[str, dict[str, Any]] = {name: {"driver": real} for name, real in REAL.items()}
    for name, values in data.items():
        _known(path, "node", name, list(_TABLES))
        if not isinstance(values, dict):
            raise FormatError(f"{path}: {name} is {values!r}; write parameters under it")
        names = [param.name for param in (*_TABLES[name], lifecycle.AUTO_START)]
        for parameter in values:
            _known(path, f"parameter of {name}", parameter, names)
        tables.setdefault(name, {}).update(values)
    return tables


def _known(path: str | os.PathLike[str], what: str, name: object, names: list[str]) -> None:
    if name in names:
        return
    near = get_close_matches(str(name), names, n=1)
    remedy = f"did you mean {near[0]}?" if near else f"choose one of {', '.join(names)}"
    raise FormatError(f"{path}: {name!r} is no {what}; {remedy}")
