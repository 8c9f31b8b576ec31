"""YAML files with a schema: one line that names file, key, value and remedy when they are wrong."""

from __future__ import annotations

import os
from difflib import get_close_matches
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from eschorty_ros.core.base.errors import EschortyError
from eschorty_ros.core.base.files import read_regular_file
from eschorty_ros.core.base.numbers import short

YAML_BYTES_MAX = 65_536


class Schema(BaseModel):
    """Base of file schemas: frozen, no unknown keys, no silent conversion, no NaN."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


Model = TypeVar("Model", bound=Schema)


class _UniqueKeyLoader(yaml.SafeLoader):
    """Refuses a key given twice, of which plain YAML silently keeps the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys: set[str] = set()
        scalars = (key for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        for key_node in scalars:
            if key_node.value in keys:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key {key_node.value!r} appears twice", key_node.start_mark
                )
            keys.add(key_node.value)
        return super().construct_mapping(node, deep)


def read_yaml(
    path: str | os.PathLike[str], error: type[EschortyError], follow_links: bool = True
) -> Any:
    """Parse a YAML file.

    Raises
    ------
    error
        When the file cannot be read or is not YAML.
    """
    data = read_regular_file(path, YAML_BYTES_MAX, error, follow_links)
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError as cause:
        raise error(f"{path}: it is not text; give a YAML file") from cause
    try:
        # A subclass of SafeLoader: it builds nothing but plain values.
        return yaml.load(text, _UniqueKeyLoader)
    except yaml.MarkedYAMLError as cause:
        mark = cause.problem_mark or cause.context_mark
        line = f" line {mark.line + 1}" if mark else ""
        raise error(f"{path}{line}: {cause.problem}; correct the YAML") from cause
    except (yaml.YAMLError, ValueError) as cause:
        raise error(f"{path}: {' '.join(str(cause).split())}; correct the YAML") from cause


def validate(
    schema: type[Model], data: Any, where: str | os.PathLike[str], error: type[EschortyError]
) -> Model:
    """Check ``data`` against ``schema``.

    Raises
    ------
    error
        With one line for the first fault and the number of further ones.
    """
    if not isinstance(data, dict):
        raise error(
            f"{where}: it has {short(data)} instead of keys; write {', '.join(_required(schema))}"
        )
    try:
        return schema.model_validate(data)
    except ValidationError as cause:
        # An unknown key first: misspelt, it is also the reason why another one is missing.
        faults = sorted(
            cause.errors(include_url=False), key=lambda fault: fault["type"] != "extra_forbidden"
        )
        more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
        raise error(f"{where}: {_line(schema, faults[0])}{more}") from cause


def _required(schema: type[Schema]) -> list[str]:
    return [name for name, field in schema.model_fields.items() if field.is_required()]


def _line(schema: type[Schema], fault: Any) -> str:
    kind, value = fault["type"], short(fault["input"])
    key = ".".join(str(part) for part in fault["loc"])
    if kind == "missing":
        return f"{key} is missing; add it"
    if kind == "extra_forbidden":
        near = get_close_matches(key, schema.model_fields, n=1)
        remedy = f"did you mean {near[0]}?" if near else "remove it"
        return f"{key} is {value}, and no such key exists; {remedy}"
    if kind == "value_error":
        reason = str(fault["ctx"]["error"])
        return f"{key} is {value}; {reason}" if key else reason
    remedy = str(fault["msg"]).replace("Input should", "it should")
    if kind == "float_type" and isinstance(fault["input"], str):
        remedy = "write a number such as 24.0 or 1.0e+3"
    return f"{key} is {value}; {remedy}"
