"""The commands of one family of waveform generators: a YAML file with a schema."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.files import config_folders
from eschorty_ros.core.base.numbers import file_path
from eschorty_ros.core.base.schema import Schema, Within, validate
from eschorty_ros.core.base.yaml_file import read_yaml

SETTINGS = (
    "output",
    "amplitude_unit",
    "load",
    "limit_enable",
    "limit_lower",
    "limit_upper",
    "mode",
    "inversion",
    "waveform",
    "frequency",
    "high",
    "low",
    "duty",
)
"""The settings that every profile describes."""
BURST_SETTINGS = ("burst_type", "burst_source", "burst_cycles", "burst_phase")
"""Those of a profile with a burst of counted cycles, besides."""

Value = bool | float | str
Text = Annotated[str, Within(low=1)]
Texts = Annotated[tuple[str, ...], Within(low=1)]
Ids = Annotated[tuple[Annotated[int, Within(0, 0xFFFF)], ...], Within(low=1)]
Positive = Annotated[float, Within(above=0.0)]
NotNegative = Annotated[float, Within(low=0.0)]


@dataclass(frozen=True, kw_only=True)
class UsbIds(Schema):
    """Product and vendor ids under which the family appears on the bus."""

    product_ids: Ids
    vendor_ids: Ids


@dataclass(frozen=True, kw_only=True)
class Replies(Schema):
    """Texts of switches in replies, and the units a number may carry."""

    on: Texts
    off: Texts
    units: dict[str, Positive]


@dataclass(frozen=True, kw_only=True)
class Setting(Schema):
    """One setting: set by ``command value``, read by ``command?``.

    ``minimum`` and ``maximum`` bound a number. A read-back equals what was set when it differs
    by ``tolerance`` plus ``tolerance_share`` of the value at most. A switch is set with the words
    ``on`` and ``off``, which count in its replies, too.
    """

    command: Text
    kind: Literal["switch", "number", "keyword"]
    minimum: float | None = None
    maximum: float | None = None
    tolerance: NotNegative = 0.0
    tolerance_share: NotNegative = 0.0
    on: Text = "ON"
    off: Text = "OFF"

    def _conflicts(self) -> Iterator[tuple[str, str]]:
        if {"{", "}"} & set(self.command.replace("{channel}", "")):
            yield "command", "only {channel} can be filled in"

    def agrees(self, requested: Value, found: Value) -> bool:
        """Return whether a read-back agrees with what was set."""
        if self.kind == "number":
            allowed = self.tolerance + self.tolerance_share * abs(float(requested))
            return abs(float(found) - float(requested)) <= allowed
        if self.kind == "keyword":
            return str(found).upper() in keyword_forms(str(requested))
        return bool(requested) == bool(found)

    def check(self, name: str, value: Value) -> None:
        """Refuse a number outside the instrument's bounds with ``ArgumentError``."""
        if self.kind != "number":
            return
        low = self.minimum if self.minimum is not None else float("-inf")
        high = self.maximum if self.maximum is not None else float("inf")
        if not low <= float(value) <= high:
            raise ArgumentError(f"{name} is {value:g}; the generator takes {low:g} to {high:g}")


@dataclass(frozen=True, kw_only=True)
class Burst(Schema):
    """A burst of counted cycles: the value of ``mode``, ``burst_type`` and ``burst_source`` for it.

    ``trigger`` starts it. What a trigger does while it runs: ``extends`` begins the count again and
    leaves the waveform as it is, ``restarts`` begins count and waveform again, ``ignored`` nothing.
    """

    mode: Text
    type: Text
    source: Text
    trigger: Text
    while_running: Literal["extends", "restarts", "ignored"]


@dataclass(frozen=True, kw_only=True)
class AwgProfile(Schema):
    """One family of generators; the keys are those of ``config/awg_*.yaml``."""

    KIND = "profile of a generator"

    name: Text
    model: str
    usb: UsbIds
    terminator: str
    channels: Annotated[int, Within(1, 8)]
    identify: str
    unlock: str | None = None
    error_queue: str | None = None
    replies: Replies
    dark_high_v: Positive
    dark_limit_v: Positive
    waveforms: dict[str, str]
    duty_waveforms: Texts
    mode_continuous: str
    burst: Burst | None = None
    settings: dict[str, Setting]

    def _conflicts(self) -> Iterator[tuple[str, str]]:
        try:
            re.compile(self.model)
        except (re.error, RecursionError, OverflowError) as error:
            yield "model", f"it is no regular expression ({error})"
        needed = SETTINGS + (BURST_SETTINGS if self.burst is not None else ())
        missing = [name for name in needed if name not in self.settings]
        if missing:
            yield "settings", f"add {', '.join(missing)}"
        unknown = sorted(set(self.settings) - set(needed))
        if unknown:
            yield "settings", f"remove {', '.join(unknown)}, which nothing uses"
        if self.dark_limit_v < self.dark_high_v:
            yield "dark_limit_v", "raise it to dark_high_v or more"


def keyword_forms(keyword: str) -> tuple[str, str]:
    """Return the two forms of a SCPI keyword in capitals: the long one, and the short one."""
    return keyword.upper(), "".join(letter for letter in keyword if not letter.islower())


def load_profile(name_or_path: str | os.PathLike[str]) -> AwgProfile:
    """Load a profile by name (``utg900e`` = ``config/awg_utg900e.yaml``) or by path.

    Raises ``ArgumentError`` when there is none, or it does not fit the schema.
    """
    path = _find(os.fspath(file_path("profile", name_or_path)))
    try:
        changed_ns = path.stat().st_mtime_ns
    except OSError:
        changed_ns = 0
    return _load(path, changed_ns)


# Kept: opening the generator to switch it off in place of a dead guard must not parse it.
@lru_cache(maxsize=4)
def _load(path: Path, changed_ns: int) -> AwgProfile:
    return validate(AwgProfile, read_yaml(path, ArgumentError), ArgumentError)


def _find(text: str) -> Path:
    if re.fullmatch(r"[A-Za-z0-9_-]+", text) is None:
        return Path(text)
    names: set[str] = set()
    for folder in config_folders():
        candidate = folder / f"awg_{text}.yaml"
        if candidate.is_file():
            return candidate
        names.update(path.stem.removeprefix("awg_") for path in folder.glob("awg_*.yaml"))
    raise ArgumentError(
        f"profile is {text!r}, and there is no such profile; choose one of "
        f"{', '.join(sorted(names))} or give a path ending in .yaml"
    )
