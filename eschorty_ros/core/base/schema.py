"""Records whose fields are checked, from code and from YAML: messages name key, value, remedy."""

from __future__ import annotations

import math
import types
from collections.abc import Iterator
from dataclasses import MISSING, asdict, dataclass, fields
from difflib import get_close_matches
from functools import cache
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from eschorty_ros.core.base.errors import ArgumentError, EschortyError
from eschorty_ros.core.base.numbers import integer, number, short
from eschorty_ros.core.base.yaml_file import Document, Keys


class Fault(NamedTuple):
    """A key that does not fit, its outer keys first, and the words that follow it."""

    keys: Keys
    words: str

    def __str__(self) -> str:
        return ".".join(map(str, self.keys)) + self.words


class FaultsError(ArgumentError):
    """The faults of one record; the message is about the first one."""

    def __init__(self, faults: list[Fault]) -> None:
        self.faults = faults
        super().__init__(_first(faults))

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.faults,)


class Within(NamedTuple):
    """Bounds of a number: ``low`` and ``high`` belong to them, ``above`` and ``below`` do not.

    Of text and tuples, ``low`` is the least length.
    """

    low: float = -math.inf
    high: float = math.inf
    above: float = -math.inf
    below: float = math.inf

    def remedy(self, kind: str) -> str:
        """Return the words for a number outside."""
        names = {"from": self.low, "above": self.above, "up to": self.high, "below": self.below}
        bounds = [f"{name} {bound:g}" for name, bound in names.items() if math.isfinite(bound)]
        return " ".join([f"choose {kind}", *bounds])


@dataclass(frozen=True, kw_only=True)
class Schema:
    """Base of records: frozen dataclasses, each field checked against its annotation.

    Annotations are ``float``, ``int``, ``str``, ``Literal``, another schema, tuples and
    dictionaries of these, or one of them and ``None``; ``Annotated[..., Within(...)]`` bounds
    them. Whole numbers become floats and lists tuples where the annotation has these; NaN and
    infinity are refused.
    """

    KIND = "record"  # without an annotation, or it would be a field

    def __post_init__(self) -> None:
        faults: list[Fault] = []
        kind: Any = type(self)
        for name, hint in _hints(kind).items():
            object.__setattr__(self, name, _checked(hint, getattr(self, name), (name,), faults))
        if not faults:
            faults = [_wrong((key,), getattr(self, key), words) for key, words in self._conflicts()]
        if faults:
            raise FaultsError(faults)

    def _conflicts(self) -> Iterator[tuple[str, str]]:
        """Iterate over keys and remedies of values that are right alone and wrong together."""
        yield from ()

    def as_dict(self) -> dict[str, Any]:
        """Return the fields that are not ``None``."""
        return {name: value for name, value in asdict(self).items() if value is not None}


Record = TypeVar("Record", bound=Schema)


def validate(schema: type[Record], document: Document, error: type[EschortyError]) -> Record:
    """Return the record that a YAML file describes.

    Raises ``error`` with one line for the first fault and the number of further ones.
    """
    required = ", ".join(field.name for field in fields(schema) if field.default is MISSING)
    if not isinstance(document.data, dict):
        raise error(
            f"{document.path}: it has {short(document.data)} instead of keys; write {required}"
        )
    strange = [key for key in document.data if not _near(schema, key)]
    if 2 * len(strange) > len(document.data):
        raise error(
            f"{document.path}: it has {short(', '.join(strange))} and is no {schema.KIND}; give "
            f"one with {required}"
        )
    faults: list[Fault] = []
    record: Record = _record(schema, document.data, (), faults)
    if faults:
        raise error(f"{document.at(faults[0].keys)}: {_first(faults)}")
    return record


def _first(faults: list[Fault]) -> str:
    return str(faults[0]) + (f" (and {len(faults) - 1} more)" if len(faults) > 1 else "")


def _wrong(keys: Keys, value: Any, remedy: str) -> Fault:
    return Fault(keys, f" is {short(value)}; {remedy}")


@cache
def _hints(schema: Any) -> dict[str, Any]:
    return get_type_hints(schema, include_extras=True)


def _near(schema: Any, key: str) -> list[str]:
    """Return the schema's key that is most like ``key``, if one is like it."""
    hints = _hints(schema)
    return [key] if key in hints else get_close_matches(key, hints, n=1)


def _record(schema: Any, data: dict[str, Any], keys: Keys, faults: list[Fault]) -> Any:
    """Return the record of ``data``; what is wrong is added to ``faults``."""
    hints, found = _hints(schema), len(faults)
    # An unknown key first: misspelt, it is also the reason why another one is missing.
    for key in data:
        if key not in hints:
            near = _near(schema, key)
            remedy = f"did you mean {near[0]}?" if near else "remove it"
            words = f" is {short(data[key])}, and no such key exists; {remedy}"
            faults.append(Fault((*keys, key), words))
    for field in fields(schema):
        if field.name not in data and field.default is MISSING:
            faults.append(Fault((*keys, field.name), " is missing; add it"))
    values = {
        key: _checked(hints[key], value, (*keys, key), faults)
        for key, value in data.items()
        if key in hints
    }
    if len(faults) > found:
        return None
    try:
        return schema(**values)
    except FaultsError as error:
        faults += [Fault((*keys, *fault.keys), fault.words) for fault in error.faults]


def _checked(hint: Any, value: Any, keys: Keys, faults: list[Fault]) -> Any:
    """Return ``value`` as its annotation has it; what is wrong is added to ``faults``."""
    bounds = Within()
    if get_origin(hint) is Annotated:
        hint, bounds = get_args(hint)
    kind, arguments = get_origin(hint) or hint, get_args(hint)
    if kind in (Union, types.UnionType):
        return None if value is None else _checked(arguments[0], value, keys, faults)
    if kind in (float, int):
        try:
            return _number(kind, value, bounds)
        except ArgumentError as error:
            faults.append(_wrong(keys, value, str(error)))
            return value
    if kind is tuple and isinstance(value, list | tuple):
        hints = arguments if ... not in arguments else arguments[:1] * len(value)
        if len(hints) == len(value) >= bounds.low:
            pairs = enumerate(zip(hints, value, strict=True))
            return tuple(_checked(h, v, (*keys, i), faults) for i, (h, v) in pairs)
        remedy = f"write {len(hints) or 'one or more'} of them"
    elif kind is dict and isinstance(value, dict):
        return {k: _checked(arguments[1], v, (*keys, k), faults) for k, v in value.items()}
    elif isinstance(kind, type) and issubclass(kind, Schema):
        if isinstance(value, kind):
            return value
        if isinstance(value, dict):
            return _record(kind, value, keys, faults)
        remedy = "write keys with values"
    elif kind is Literal:
        if value in arguments:
            return value
        remedy = f"choose one of {', '.join(arguments)}"
    elif kind is str:
        if isinstance(value, str) and len(value) >= bounds.low:
            return value
        remedy = "write text"
    else:
        remedy = "write keys with values" if kind is dict else "write a list"
    faults.append(_wrong(keys, value, remedy))
    return value


def _number(kind: type, value: Any, bounds: Within) -> float:
    """Return a number of ``kind``; the message of the error is the remedy."""
    remedy = bounds.remedy("a whole number" if kind is int else "a finite number")
    if isinstance(value, str):
        remedy = "write a number such as 24 or 1.0e+3"
    try:
        check = integer if kind is int else number
        found = check("value", value, bounds.low, bounds.high)  # type: ignore[arg-type]
    except ArgumentError:
        raise ArgumentError(remedy) from None
    if not bounds.above < found < bounds.below:
        raise ArgumentError(remedy)
    return found
