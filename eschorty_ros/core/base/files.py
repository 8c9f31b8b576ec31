"""Folders of configuration; regular files of bounded size; files that are complete or absent."""

from __future__ import annotations

import fcntl
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, Self

from eschorty_ros.core.base.errors import ArgumentError, EschortyError, FormatError
from eschorty_ros.core.base.numbers import file_path, short

_PARTIAL = ".eschorty-partial"
NAME_MAX = 100
BARE_NAME = f"1 to {NAME_MAX} printable characters without slashes, the first no dot"


def is_bare_name(value: object) -> bool:
    """Return whether ``value`` names a file in a folder: no path, not hidden, on one line."""
    text = value if isinstance(value, str) and len(value) <= NAME_MAX else ""
    return text.isprintable() and not {"", "."} & {text[:1]} and not set("/\\") & set(text)


def bare_name_fault(name: str, value: object) -> str:
    """Return what is wrong with ``value``, the ``name``, as a bare name; ``""`` for nothing."""
    return "" if is_bare_name(value) else f"{name} is {short(value)}; give {BARE_NAME}"


def open_regular_file(
    path: str | os.PathLike[str], error: type[EschortyError], follow_links: bool = True
) -> BinaryIO:
    """Open a regular file for reading; devices and pipes are refused without opening them.

    Raises ``error`` when there is no such file or it cannot be opened.
    """
    file = file_path("path", path)
    flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | (0 if follow_links else os.O_NOFOLLOW)
    try:
        _check_regular(file, os.stat(file, follow_symlinks=follow_links), error)
        stream = open(os.open(file, flags), "rb")  # noqa: SIM115 - the caller's
    except OSError as cause:
        raise error(f"cannot read {file}: {cause.strerror or cause}; check the path") from cause
    try:
        # The name may stand for another file by now.
        _check_regular(file, os.fstat(stream.fileno()), error)
    except BaseException:
        stream.close()
        raise
    return stream


def read_regular_file(
    path: str | os.PathLike[str],
    bytes_max: int,
    error: type[EschortyError],
    follow_links: bool = True,
) -> bytes:
    """Return the content of a regular file of at most ``bytes_max``, else raise ``error``."""
    with open_regular_file(path, error, follow_links) as stream:
        try:
            data = stream.read(bytes_max + 1)
        except OSError as cause:
            raise error(f"cannot read {path}: {cause.strerror or cause}; check it") from cause
    if len(data) > bytes_max:
        raise error(f"cannot read {path}: it is larger than {bytes_max} bytes; check the path")
    return data


def _check_regular(file: Path, found: os.stat_result, error: type[EschortyError]) -> None:
    if not stat.S_ISREG(found.st_mode):
        kind = "a link" if stat.S_ISLNK(found.st_mode) else "no regular file"
        raise error(f"cannot read {file}: it is {kind}; give a regular file")


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a binary file that takes the name ``path`` only when the block ends without error.

    Raises ``ArgumentError`` when the file cannot be written; names the path and the reason.
    """
    target = _target(path)
    with _named(target), _partial(target.parent) as folder:
        file = folder / target.name
        with file.open("xb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        file.replace(target)


@contextmanager
def atomic_files(folder: Path, names: Sequence[str]) -> Iterator[Path]:
    """Make a folder whose files ``names`` move to ``folder`` when the block ends without error.

    The first of ``names`` is removed there before the others come and is the last to come itself,
    so that files of two runs never look complete together.
    """
    with _named(folder), _partial(folder) as made:
        yield made
        (folder / names[0]).unlink(missing_ok=True)
        for name in reversed(names):
            (made / name).replace(folder / name)


def make_folder(path: str | os.PathLike[str]) -> Path:
    """Make a folder, and those it is in, unless it is there; return its path.

    Raises ``ArgumentError`` when it cannot be made; names the path and the reason.
    """
    folder = file_path("path", path)
    with _named(folder):
        folder.mkdir(parents=True, exist_ok=True)
    return folder


def check_writable(path: str | os.PathLike[str]) -> None:
    """Check before long work that ``atomic_write`` can write ``path``; leaves nothing behind.

    Raises ``ArgumentError`` when it cannot; names the path and the reason.
    """
    with folder_beside(path) as folder:
        (folder / _target(path).name).touch()


@contextmanager
def folder_beside(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Make a folder for short-lived files in the folder of ``path``, as `temporary_folder`.

    Raises ``ArgumentError`` when nothing can be written there; names the path and the reason.
    """
    target = _target(path)
    with _named(target), _partial(target.parent) as folder:
        yield folder


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """Make a folder for short-lived files; one of a run that was killed is removed by the next."""
    with _partial(Path(tempfile.gettempdir()), f"eschorty_{os.getuid()}_", "") as folder:
        yield folder


class GrowingFile:
    """A new file that grows by all of the data of a call, or by nothing.

    - ``path``: Replaced when it exists.

    Raises ``FormatError`` when it cannot be written; names the path and the reason.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._file = path.open("wb", buffering=0)
        except OSError as error:
            raise FormatError(f"{path}: {error.strerror or error}; choose another") from error

    def write(self, data: bytes | memoryview) -> None:
        """Append ``data``; they stay there also when the process is killed."""
        end, view = self._file.tell(), memoryview(data)
        try:
            while view:
                view = view[self._file.write(view) :]
        except OSError as error:
            # The disk may be gone.
            with suppress(OSError):
                self._file.truncate(end)
                self._file.seek(end)
            raise self._full(error) from error

    def close(self) -> None:
        """Finish the file; idempotent."""
        try:
            self._file.close()
        except OSError as error:
            raise self._full(error) from error

    def _full(self, error: OSError) -> FormatError:
        return FormatError(f"{self.path}: {error.strerror or error}; free some space")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def remove_abandoned(parent: Path, prefix: str = ".", suffix: str = _PARTIAL) -> None:
    """Remove the temporary folders in ``parent`` whose process is gone."""
    for other in parent.glob(f"{prefix}*{suffix}"):
        with suppress(OSError):
            lock = _lock(other)
            shutil.rmtree(other, ignore_errors=True)
            os.close(lock)


@contextmanager
def _partial(parent: Path, prefix: str = ".", suffix: str = _PARTIAL) -> Iterator[Path]:
    """Make a folder in ``parent``, locked while it is in use."""
    remove_abandoned(parent, prefix, suffix)
    while True:
        folder = Path(tempfile.mkdtemp(suffix, prefix, parent))
        # Another process may have taken it for an old one before it was locked.
        with suppress(BlockingIOError, FileNotFoundError):
            lock = _lock(folder)
            break
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


def _lock(folder: Path) -> int:
    """Return a handle that holds the folder's lock, at most until the process ends."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.stat(folder)
    except OSError:
        os.close(handle)
        raise
    return handle


def _target(path: str | os.PathLike[str]) -> Path:
    target = file_path("path", path)
    with _named(target):
        other = target.exists() and not target.is_file()
    if other or not target.name:
        kind = "a folder" if target.is_dir() or not target.name else "no regular file"
        raise ArgumentError(f"cannot write {target}: it is {kind}; give the name of a file")
    return target


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


def config_path(name: str) -> Path | None:
    """Return the path of a file in ``config/``, ``None`` when there is none."""
    return next((path for f in config_folders() if (path := f / name).is_file()), None)


def config_folders() -> list[Path]:
    """Return where ``config/`` may lie: source tree, pip-installed package, colcon's share."""
    here = Path(__file__).absolute()
    return [
        here.parents[3] / "config",
        here.parents[2] / "config",
        *(prefix / "share" / "eschorty_ros" / "config" for prefix in here.parents),
    ]
