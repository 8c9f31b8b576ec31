"""Folders of configuration; regular files of bounded size; files that are complete or absent."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from eschorty_ros.core.base.errors import ArgumentError, EschortyError
from eschorty_ros.core.base.numbers import file_path

NAME_MAX = 100
BARE_NAME = f"1 to {NAME_MAX} printable characters without slashes, the first no dot"


def is_bare_name(value: object) -> bool:
    """Return whether ``value`` names a file in a folder: no path, not hidden, on one line."""
    text = value if isinstance(value, str) and len(value) <= NAME_MAX else ""
    return text.isprintable() and not {"", "."} & {text[:1]} and not set("/\\") & set(text)


def read_regular_file(
    path: str | os.PathLike[str],
    bytes_max: int,
    error: type[EschortyError],
    follow_links: bool = True,
) -> bytes:
    """Return the content of a regular file; devices and pipes are refused without opening them.

    Raises
    ------
    error
        When there is no such file, it cannot be read or holds more than ``bytes_max``.
    """
    file = file_path("path", path)
    flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | (0 if follow_links else os.O_NOFOLLOW)
    try:
        _check_regular(file, os.stat(file, follow_symlinks=follow_links), error)
        with open(os.open(file, flags), "rb") as stream:
            # The name may stand for another file by now.
            _check_regular(file, os.fstat(stream.fileno()), error)
            data = stream.read(bytes_max + 1)
    except OSError as cause:
        raise error(f"cannot read {file}: {cause.strerror or cause}; check the path") from cause
    if len(data) > bytes_max:
        raise error(f"cannot read {file}: it is larger than {bytes_max} bytes; check the path")
    return data


def _check_regular(file: Path, found: os.stat_result, error: type[EschortyError]) -> None:
    if not stat.S_ISREG(found.st_mode):
        kind = "a link" if stat.S_ISLNK(found.st_mode) else "no regular file"
        raise error(f"cannot read {file}: it is {kind}; give a regular file")


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a binary file that takes the name ``path`` only when the block ends without error.

    Raises
    ------
    ArgumentError
        When the file cannot be written; names the path and the reason.
    """
    target = _target(path)
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
    target = _target(path)
    partial = _partial(target)
    try:
        with _named(target):
            partial.touch()
    finally:
        with suppress(OSError):
            partial.unlink()


def _target(path: str | os.PathLike[str]) -> Path:
    target = file_path("path", path)
    with _named(target):
        other = target.exists() and not target.is_file()
    if other or not target.name:
        kind = "a folder" if target.is_dir() or not target.name else "no regular file"
        raise ArgumentError(f"cannot write {target}: it is {kind}; give the name of a file")
    return target


def _partial(target: Path) -> Path:
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
