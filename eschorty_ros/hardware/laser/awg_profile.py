"""The commands of one family of waveform generators: a YAML file with a schema."""

from __future__ import annotations

import os
import re
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.files import config_folders
from eschorty_ros.core.base.numbers import file_path
from eschorty_ros.core.base.yaml_file import Schema, read_yaml, validate

SETTINGS = (
    "output",
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
Texts = Annotated[tuple[str, ...], Field(strict=False, min_length=1)]
Ids = Annotated[
    tuple[Annotated[int, Field(ge=0, le=0xFFFF)], ...], Field(strict=False, min_length=1)
]
NotNegative = Annotated[float, Field(ge=0.0)]


class UsbIds(Schema):
    """Product and vendor ids under which the family appears on the bus."""

    product_ids: Ids
    vendor_ids: Ids


class Replies(Schema):
    """Texts of switches in replies, and the units a number may carry."""

    on: Texts
    off: Texts
    units: dict[str, Annotated[float, Field(gt=0.0)]]


class Setting(Schema):
    """One setting: set by ``command value``, read by ``command?``.

    ``minimum`` and ``maximum`` bound a number. A read-back equals what was set when it differs
    by ``tolerance`` plus ``tolerance_share`` of the value at most.
    """

    command: Annotated[str, Field(min_length=1)]
    kind: Literal["switch", "number", "keyword"]
    minimum: float | None = None
    maximum: float | None = None
    tolerance: NotNegative = 0.0
    tolerance_share: NotNegative = 0.0

    @field_validator("command")
    @classmethod
    def _fits(cls, value: str) -> str:
        try:
            value.format(channel=1)
        except (KeyError, IndexError, ValueError):
            raise ValueError("only {channel} can be filled in") from None
        return value

    def agrees(self, requested: Value, found: Value) -> bool:
        """Return whether a read-back agrees with what was set."""
        if self.kind == "number":
            allowed = self.tolerance + self.tolerance_share * abs(float(requested))
            return abs(float(found) - float(requested)) <= allowed
        if self.kind == "keyword":
            # SCPI keywords have a long form and a short one, which is its capitals.
            short = "".join(letter for letter in str(requested) if not letter.islower())
            return str(found).upper() in (str(requested).upper(), short)
        return bool(requested) == bool(found)

    def check(self, name: str, value: Value) -> None:
        """Refuse a number outside the instrument's bounds with ``ArgumentError``."""
        if self.kind != "number":
            return
        low = self.minimum if self.minimum is not None else float("-inf")
        high = self.maximum if self.maximum is not None else float("inf")
        if not low <= float(value) <= high:
            raise ArgumentError(f"{name} is {value:g}; the generator takes {low:g} to {high:g}")


class Burst(Schema):
    """A burst of counted cycles: the value of ``mode``, ``burst_type`` and ``burst_source`` for it.

    ``trigger`` starts it. What a trigger does while it runs: ``extends`` begins the count again and
    leaves the waveform as it is, ``restarts`` begins count and waveform again, ``ignored`` nothing.
    """

    mode: Annotated[str, Field(min_length=1)]
    type: Annotated[str, Field(min_length=1)]
    source: Annotated[str, Field(min_length=1)]
    trigger: Annotated[str, Field(min_length=1)]
    while_running: Literal["extends", "restarts", "ignored"]


class AwgProfile(Schema):
    """One family of generators; the keys are those of ``config/awg_*.yaml``."""

    name: Annotated[str, Field(min_length=1)]
    maker: str
    model: str
    usb: UsbIds
    terminator: str
    channels: Annotated[int, Field(ge=1, le=8)]
    identify: str
    unlock: str | None = None
    error_queue: str | None = None
    replies: Replies
    dark_high_v: Annotated[float, Field(gt=0.0)]
    dark_limit_v: Annotated[float, Field(gt=0.0)]
    waveforms: dict[str, str]
    duty_waveforms: Texts
    mode_continuous: str
    burst: Burst | None = None
    settings: dict[str, Setting]

    @field_validator("model")
    @classmethod
    def _compiles(cls, value: str) -> str:
        try:
            re.compile(value)
        except re.error as error:
            raise ValueError(f"it is no regular expression ({error})") from None
        return value

    @model_validator(mode="after")
    def _complete(self) -> AwgProfile:
        needed = SETTINGS + (BURST_SETTINGS if self.burst is not None else ())
        missing = [name for name in needed if name not in self.settings]
        if missing:
            raise ValueError(f"settings lack {', '.join(missing)}; add them")
        unknown = sorted(set(self.settings) - set(needed))
        if unknown:
            raise ValueError(f"settings hold {', '.join(unknown)}, which nothing uses; remove them")
        if self.dark_limit_v < self.dark_high_v:
            raise ValueError("dark_limit_v lies below dark_high_v; raise it")
        return self


def load_profile(name_or_path: str | os.PathLike[str]) -> AwgProfile:
    """Load a profile by name (``utg900e`` = ``config/awg_utg900e.yaml``) or by path.

    Raises
    ------
    ArgumentError
        When there is none, or it does not fit the schema.
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
    return validate(AwgProfile, read_yaml(path, ArgumentError), path, ArgumentError)


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
