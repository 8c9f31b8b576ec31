"""ROS parameters from tables with description, unit and range; every refusal has a reason."""

from __future__ import annotations

import dataclasses
import math
from array import array
from collections.abc import Callable, Iterable, Mapping, Sequence
from difflib import get_close_matches
from typing import Any, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterUninitializedException,
)
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import HistoryPolicy, ReliabilityPolicy

from eschorty_ros.core.base.errors import ArgumentError, EschortyError
from eschorty_ros.core.base.numbers import short

_QOS = "qos_overrides"
_DEPTH_MAX = 1_000_000
_OF_ROS = (_QOS, "start_type_description_service", "use_sim_time")

Settings = TypeVar("Settings")
Value = bool | int | float | str | tuple[int, ...]


@dataclasses.dataclass(frozen=True, slots=True)
class Param:
    """One parameter of a node, or argument of a launch file."""

    name: str
    default: Value | None
    """Its type is the parameter's type; an integer is accepted for a float.

    ``None`` for an argument that must be given.
    """
    description: str
    unit: str = ""
    """SI."""
    minimum: float | None = None
    maximum: float | None = None
    """Inclusive bounds of a number; both or neither."""
    choices: tuple[str, ...] = ()
    """The accepted strings; empty means any."""
    dynamic: bool = False
    """Whether the value may change after the node has started."""

    def descriptor(self) -> ParameterDescriptor:
        """Return the ROS descriptor: description with unit, range, constraint, read-only flag."""
        descriptor = ParameterDescriptor(
            name=self.name,
            description=f"{self.description} [{self.unit}]" if self.unit else self.description,
            read_only=not self.dynamic,
        )
        if self.choices:
            descriptor.additional_constraints = f"one of: {', '.join(self.choices)}"
        if self.minimum is not None and self.maximum is not None:
            if isinstance(self.default, float):
                bounds = FloatingPointRange(
                    from_value=float(self.minimum), to_value=float(self.maximum)
                )
                descriptor.floating_point_range = [bounds]
            else:
                descriptor.integer_range = [
                    IntegerRange(from_value=int(self.minimum), to_value=int(self.maximum), step=1)
                ]
        return descriptor

    def converted(self, value: Any) -> Any:
        """Return the value of the parameter that ``value`` stands for, else itself.

        That is an integer's for a float, and in YAML, which ROS reads, the words on and off are
        truth values.
        """
        if isinstance(self.default, float) and type(value) is int:
            return float(value)
        if isinstance(value, bool):
            word = "on" if value else "off"
            return word if word in self.choices else value
        return value

    def check(self, value: Any, what: str = "parameter") -> None:
        """Raise ``ArgumentError`` unless ``value`` has type and range, or is one of the choices."""
        given = f"{what} {self.name} is {short(value)}"
        if not self._has_type(value):
            raise ArgumentError(
                f"{given}; give a value of type {type(self.default).__name__}, "
                f"such as {short(self.default)}"
            )
        if self.choices and value not in self.choices:
            raise ArgumentError(f"{given}; choose one of {', '.join(self.choices)}")
        if (
            self.minimum is not None
            and self.maximum is not None
            and not self.minimum <= value <= self.maximum
        ):
            raise ArgumentError(f"{given}; its range is {self.minimum:g} to {self.maximum:g}")

    def _has_type(self, value: Any) -> bool:
        if isinstance(self.default, tuple):
            several = isinstance(value, list | tuple | array)
            return several and all(type(each) is int for each in value)
        if isinstance(self.default, float):
            return type(value) in (int, float) and math.isfinite(value)
        return type(value) is type(self.default)


def check_name(name: object, what: str, names: Sequence[str]) -> None:
    """Raise ``ArgumentError`` with the nearest name unless ``name`` is one of ``names``."""
    if name in names:
        return
    near = get_close_matches(str(name), names, n=1, cutoff=0.5)
    remedy = f"did you mean {near[0]}?" if near else "docs/interfaces.md has all of them"
    raise ArgumentError(f"{short(name)} is no {what}; {remedy}")


def of_ros(name: object) -> bool:
    """Return whether every node of ROS has the parameter ``name``."""
    return str(name).partition(".")[0] in _OF_ROS


def from_settings(settings_class: type[Any], *, dynamic: bool = False) -> tuple[Param, ...]:
    """Return parameters of a dataclass whose fields carry ``description, unit, range, choices``."""
    table = []
    for field in dataclasses.fields(settings_class):
        default: Any = field.default
        meta = field.metadata
        low, high = meta.get("range", (None, None))
        choices = meta.get("choices", ())
        table.append(
            Param(
                field.name, default, meta["description"], meta["unit"], low, high, choices, dynamic
            )
        )
    return tuple(table)


def settings_of(values: Mapping[str, Any], settings_class: type[Settings]) -> Settings:
    """Return the dataclass that ``from_settings`` made parameters of, with their values."""
    names = [param.name for param in from_settings(settings_class)]
    return settings_class(**{name: values[name] for name in names})


class Parameters(Mapping[str, Any]):
    """The declared parameters of a node, read as a mapping of names to values.

    - ``on_change``: Called with all values as they would be after a change, before it is accepted.
      It applies the change, so that a device can refuse it: an ``EschortyError`` refuses the change
      and its text is the reason that the caller receives.

    Raises ``ArgumentError`` when a value given at start has the wrong type, is out of range or not
    a choice, or a name is unknown.
    """

    def __init__(
        self,
        node: Node,
        table: Iterable[Param],
        on_change: Callable[[dict[str, Any]], None] | None = None,
    ) -> None:
        self._node = node
        self._table = {param.name: param for param in table}
        self._on_change = on_change
        # ROS ignores an unknown name: a misspelt safety limit would have no effect.
        for name, given in node._parameter_overrides.items():
            if not of_ros(name):
                check_name(name, f"parameter of {node.get_name()}", tuple(self._table))
            elif name.startswith(f"{_QOS}."):
                _check_quality(name, given.value)
        for param in self._table.values():
            _declare(node, param)
            param.check(self[param.name])
        if any(param.dynamic for param in self._table.values()):
            node.add_pre_set_parameters_callback(self._coerce)
        node.add_on_set_parameters_callback(self._validate)

    def __getitem__(self, name: str) -> Any:
        if name not in self._table:
            raise KeyError(name)
        return self._node.get_parameter(name).value

    def __iter__(self) -> Any:
        return iter(self._table)

    def __len__(self) -> int:
        return len(self._table)

    def _coerce(self, proposed: list[Parameter[Any]]) -> list[Parameter[Any]]:
        return [self._as_declared(parameter) for parameter in proposed]

    def _as_declared(self, parameter: Parameter[Any]) -> Parameter[Any]:
        declared = self._table.get(parameter.name)
        if declared is None:
            return parameter
        given = parameter.value
        value = declared.converted(given)
        return parameter if value is given else Parameter(parameter.name, value=value)

    def _validate(self, proposed: Sequence[Parameter[Any]]) -> SetParametersResult:
        changes = {p.name: p.value for p in proposed if p.name in self._table}
        if not changes:
            return SetParametersResult(successful=True)
        try:
            for name, value in changes.items():
                self._table[name].check(value)
            if self._on_change is not None:
                self._on_change({**self, **changes})
        except EschortyError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)


def _check_quality(name: str, value: Any) -> None:
    """Raise ``ArgumentError`` unless ``value`` is one of a policy that ``qos.overridable`` has.

    rclpy would end with a traceback.
    """
    params = {
        "depth": Param(name, 1, "", minimum=1, maximum=_DEPTH_MAX),
        "history": Param(name, "keep_last", "", choices=_words(HistoryPolicy)),
        "reliability": Param(name, "reliable", "", choices=_words(ReliabilityPolicy)),
    }
    if param := params.get(name.rpartition(".")[2]):
        param.check(value.lower() if isinstance(value, str) else value)


def _words(policy: Any) -> tuple[str, ...]:
    return tuple(word for word in policy.short_keys() if word != "unknown")


def _declare(node: Node, param: Param) -> None:
    try:
        try:
            node.declare_parameter(param.name, param.default, param.descriptor())
        except InvalidParameterTypeException:
            value = _given(node, param)
            node.declare_parameter(param.name, value, param.descriptor(), ignore_override=True)
    except (
        InvalidParameterTypeException,
        InvalidParameterValueException,
        ParameterUninitializedException,
    ) as error:
        raise ArgumentError(f"parameter {param.name} refused: {error}") from error


def _given(node: Node, param: Param) -> Any:
    """Return the value given at start in another type, in the parameter's one."""
    probe = ParameterDescriptor(dynamic_typing=True)
    given = node.declare_parameter(param.name, param.default, probe).value
    node.undeclare_parameter(param.name)
    value = param.converted(given)
    param.check(value)
    return value
