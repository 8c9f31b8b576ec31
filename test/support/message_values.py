"""Hypothesis strategies of ROS messages: every field at the extremes of its type."""

import importlib
import math
from typing import Any

from hypothesis import strategies as st
from rosidl_parser.definition import (
    AbstractNestedType,
    AbstractString,
    AbstractWString,
    Array,
    BasicType,
    NamespacedType,
)

TEXTS = ("", "a", "evt3", "square", "sine", "9" * 5000, "x" * 70_000, "\u2603" * 300, "a b 9" * 9,
         "frequency", "paper", "\n", "%s%n{}", "nan")  # fmt: skip
_FLOATS = (0.0, -0.0, 1.0, -1.0, 0.01, 5e-324, 1e-9, 1e300, 3e38, math.inf, -math.inf, math.nan)
_LENGTHS = (0, 1, 2, 300)


def interface(name: str) -> Any:
    """Return the class of an interface named as ``package/kind/Name``."""
    package, kind, name = name.split("/")
    module = importlib.import_module(f"{package}.{kind}")
    action, _, part = name.partition("_")
    if kind != "action" or not part:
        return getattr(module, name)
    kinds = {**vars(getattr(module, action).Impl), **vars(getattr(module, action))}
    return kinds.get(part) or kinds[f"{part}Service"]


def messages(kind: Any) -> st.SearchStrategy[Any]:
    """Return a strategy of messages of a class."""
    names = [slot.lstrip("_") for slot in kind.__slots__ if slot != "_check_fields"]
    fields = [_values(slot_type) for slot_type in kind.SLOT_TYPES]

    def made(values: tuple[Any, ...]) -> Any:
        message = kind()
        for name, value in zip(names, values, strict=True):
            setattr(message, name, value)
        return message

    return st.tuples(*fields).map(made)


def _values(kind: Any) -> st.SearchStrategy[Any]:
    if isinstance(kind, NamespacedType):
        return messages(interface("/".join(kind.namespaced_name())))
    if isinstance(kind, AbstractString | AbstractWString):
        return st.sampled_from(TEXTS)
    if isinstance(kind, Array):
        return st.lists(_values(kind.value_type), min_size=kind.size, max_size=kind.size)
    if isinstance(kind, AbstractNestedType):
        # One value repeated: long sequences of drawn values would take too long to make.
        size = st.sampled_from(_LENGTHS)
        return st.builds(lambda value, count: [value] * count, _values(kind.value_type), size)
    return _basic(kind)


def _basic(kind: BasicType) -> st.SearchStrategy[Any]:
    name = kind.typename
    if name == "boolean":
        return st.booleans()
    if name == "octet":
        return st.sampled_from([b"\x00", b"\x01", b"\xff"])
    if name in ("float", "double"):
        return st.sampled_from(_FLOATS if name == "double" else _FLOATS[:7] + _FLOATS[8:])
    bits = int(name.lstrip("uint"))
    low, high = (0, (1 << bits) - 1) if name[0] == "u" else (-(1 << bits - 1), (1 << bits - 1) - 1)
    return st.sampled_from(sorted({low, low + 1, 0, 1, 2, high // 2, high - 1, high}))
