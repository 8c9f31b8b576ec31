"""Folders of configuration; files that are complete or absent: written beside, then renamed."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.numbers import file_path


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a binary file that takes the name ``path`` only when the block ends without error.

    Raises
    ------
    ArgumentError
        When the file cannot be written; names the path and the reason.
    """
    target = file_path("path", path)
    partial = _partial(target)
    try:
        with _named(target):
            with partial.open("wb") as stream:
                yield stream
                stream.flush()
                os.fsync(stream.fileno())
            partial.replace(target)
    finally:
        with suppress(OSError):
            partial.unlink()


def check_writable(path: str | os.PathLike[str]) -> None:
    """Check before long work that ``atomic_write`` can write ``path``; leaves nothing behind.

    Raises
    ------
    ArgumentError
        When it cannot; names the path and the reason.
    """
    target = file_path("path", path)
    if target.is_dir():
        raise ArgumentError(f"cannot write {target}: it is a folder; give the name of a file")
    partial = _partial(target)
    try:
        with _named(target):
            partial.touch()
    finally:
        with suppress(OSError):
            partial.unlink()


def _partial(target: Path) -> Path:
    if not target.name:
        raise ArgumentError(f"cannot write {target}; give the name of a file")
    return target.with_name(f".{target.name}.{os.getpid()}.partial")


@contextmanager
def _named(target: Path) -> Iterator[None]:
    """Raise the system's errors as an ``ArgumentError`` that names the file."""
    try:
        yield
    except OSError as error:
        raise ArgumentError(
            f"cannot write {target}: {error.strerror or error}; choose a folder that exists, "
            "is writable and has room"
        ) from error


def config_folders() -> list[Path]:
    """Return where ``config/`` may lie: source tree, pip-installed package, colcon's share."""
    here = Path(__file__).absolute()
    return [
        here.parents[3] / "config",
        here.parents[2] / "config",
        *(prefix / "share" / "eschorty_ros" / "config" for prefix in here.parents),
    ]
