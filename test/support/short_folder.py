"""Where Unix sockets of tests lie: their paths are limited to 107 bytes."""

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def short_folder() -> Iterator[Path]:
    """A folder whose path leaves room for a Unix socket's, other than pytest's own."""
    with tempfile.TemporaryDirectory(prefix="bench_") as folder:
        yield Path(folder)
