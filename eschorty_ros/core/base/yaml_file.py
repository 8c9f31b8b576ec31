"""YAML files from anywhere: bounded in size, depth and numbers; one line names every fault.

The parser's events become plain values here, without the library's constructors: nothing can be
referred to twice, carry a tag or grow beyond what the file holds.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import yaml

from eschorty_ros.core.base.errors import EschortyError
from eschorty_ros.core.base.files import atomic_write, read_regular_file
from eschorty_ros.core.base.numbers import short

BYTES_MAX = 65_536
DEPTH_MAX = 20
NUMBER_MAX = 60
"""Characters of a number."""

_TAG_PREFIX = "tag:yaml.org,2002:"
_RESOLVER = yaml.resolver.Resolver()
_SCALARS = yaml.constructor.SafeConstructor()

Keys = tuple[str | int, ...]


@dataclass(frozen=True)
class Document:
    """The content of a YAML file: text, numbers, truth values, ``None``, lists, dictionaries."""

    path: str
    data: Any
    lines: dict[Keys, int]
    """Line of each entry; keys of an entry from the outermost one."""

    def at(self, keys: Keys) -> str:
        """Return file and line of an entry, or of the innermost one around it."""
        while keys and keys not in self.lines:
            keys = keys[:-1]
        return f"{self.path} line {self.lines[keys]}" if keys else self.path


def read_yaml(
    path: str | os.PathLike[str], error: type[EschortyError], follow_links: bool = True
) -> Document:
    """Return the content of a YAML file.

    Raises ``error`` when the file cannot be read, is too large or is not plain YAML.
    """
    data = read_regular_file(path, BYTES_MAX, error, follow_links)
    return parse_yaml(data, path, error)


def parse_yaml(data: bytes, path: str | os.PathLike[str], error: type[EschortyError]) -> Document:
    """Return the content of a YAML file from its bytes; ``path`` is for messages."""
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as cause:
        raise error(f"{path}: it is not text; give a YAML file") from cause
    builder = _Builder()
    loader = None
    try:
        loader = yaml.SafeLoader(text)
        while loader.check_event():
            builder.add(loader.get_event())
    except yaml.MarkedYAMLError as cause:
        mark = cause.problem_mark or cause.context_mark
        line = mark.line if mark else 0
        reason = cause.problem or cause.context or "it is not YAML"
    except yaml.reader.ReaderError as cause:
        line = text.count("\n", 0, cause.position)
        reason = "a character that YAML does not allow"
    except _Refused as cause:
        line, reason = cause.line, str(cause)
    except (ValueError, ArithmeticError, LookupError) as cause:
        # The library converts numbers of escapes and directives without a check.
        line, reason = getattr(loader, "line", 0), f"an escape or directive ({cause})"
    else:
        return Document(os.fspath(path), builder.data, builder.lines)
    raise error(f"{path} line {line + 1}: {reason}; correct the YAML")


def write_yaml(path: str | os.PathLike[str], data: Mapping[str, Any]) -> None:
    """Write a YAML file atomically, the keys in their order.

    Raises ``ArgumentError`` when the path cannot be written.
    """
    with atomic_write(path) as stream:
        stream.write(yaml.safe_dump(dict(data), sort_keys=False).encode())


class _Refused(Exception):  # noqa: N818 - leaves this file as the caller's error
    def __init__(self, event: yaml.Event, reason: str) -> None:
        super().__init__(reason)
        self.line = event.start_mark.line if event.start_mark else 0


@dataclass
class _Open:
    """A list or dictionary whose end has not come."""

    values: Any
    keys: Keys
    key: str | None = None


@dataclass
class _Builder:
    """Values and lines from the parser's events."""

    data: Any = None
    lines: dict[Keys, int] = field(default_factory=dict)
    _open: list[_Open] = field(default_factory=list)
    _documents: int = 0

    def add(self, event: yaml.Event) -> None:
        if isinstance(event, yaml.DocumentStartEvent):
            self._documents += 1
            if self._documents > 1:
                raise _Refused(event, "a second document begins")
        elif isinstance(event, yaml.MappingEndEvent | yaml.SequenceEndEvent):
            self._open.pop()
        elif isinstance(event, yaml.NodeEvent):
            self._add_node(event)

    def _add_node(self, event: Any) -> None:
        if event.anchor is not None:
            raise _Refused(event, f"anchors and aliases such as {short(event.anchor)} are not read")
        if event.tag is not None:
            raise _Refused(event, f"tags such as {short(event.tag)} are not read")
        parent = self._open[-1] if self._open else None
        if parent is not None and isinstance(parent.values, dict) and parent.key is None:
            self._add_key(event, parent)
            return
        keys: Keys = ()
        if parent is not None:
            dictionary = isinstance(parent.values, dict)
            keys = (*parent.keys, parent.key if dictionary else len(parent.values))  # type: ignore[arg-type]
            self.lines.setdefault(keys, event.start_mark.line + 1)
        if isinstance(event, yaml.ScalarEvent):
            value = _scalar(event)
        else:
            value = {} if isinstance(event, yaml.MappingStartEvent) else []
            if len(self._open) == DEPTH_MAX:
                raise _Refused(event, f"it is nested more than {DEPTH_MAX} deep")
            self._open.append(_Open(value, keys))
        if parent is None:
            self.data = value
        elif isinstance(parent.values, dict):
            parent.values[parent.key], parent.key = value, None
        else:
            parent.values.append(value)

    def _add_key(self, event: Any, parent: _Open) -> None:
        line = event.start_mark.line + 1
        if not isinstance(event, yaml.ScalarEvent):
            raise _Refused(event, "a key is a list or a dictionary")
        if event.value in parent.values:
            raise _Refused(event, f"key {short(event.value)} appears twice")
        parent.key = event.value
        self.lines[(*parent.keys, event.value)] = line


def _scalar(event: yaml.ScalarEvent) -> Any:
    """Return text, a number, a truth value or ``None``; dates stay text."""
    tag = _RESOLVER.resolve(yaml.ScalarNode, event.value, event.implicit)
    kind = tag.removeprefix(_TAG_PREFIX)
    if kind == "null":
        return None
    if kind == "bool":
        return _SCALARS.bool_values[event.value.lower()]
    if kind not in ("int", "float"):
        return event.value
    if len(event.value) > NUMBER_MAX:
        raise _Refused(event, f"a number of {len(event.value)} characters")
    node = yaml.ScalarNode(tag, event.value)
    try:
        if kind == "int":
            return _SCALARS.construct_yaml_int(node)
        return _SCALARS.construct_yaml_float(node)
    except (ValueError, ArithmeticError, LookupError):
        raise _Refused(event, f"{short(event.value)} is no number") from None
