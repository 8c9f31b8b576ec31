"""Emulated benches for tests, in this process or in another.

``python benches.py FOLDER SETTINGS``, with ``BenchSettings`` as JSON, serves a bench and sets each
scene that it reads from standard input.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from short_folder import short_folder

from eschorty_ros.emulation.bench.devices import Bench, BenchSettings
from eschorty_ros.emulation.bench.process import bench_process
from eschorty_ros.emulation.bench.server import serving


@contextlib.contextmanager
def bench_here(**settings: Any) -> Iterator[tuple[Bench, Path]]:
    """Yield a bench with these ``BenchSettings`` in this process, and its folder."""
    bench = Bench(BenchSettings(**settings))
    with short_folder() as folder, serving(bench, folder):
        yield bench, folder


@contextlib.contextmanager
def bench_elsewhere(**options: Any) -> Iterator[Path]:
    """Yield the folder of a bench with these options in another process."""
    with short_folder() as folder:
        names = {name.replace("_", "-"): value for name, value in options.items()}
        with bench_process(folder, names):
            yield folder


class RemoteBench:
    """A bench in another process whose scene can be changed."""

    def __init__(self, folder: Path, settings: dict[str, Any]) -> None:
        self.folder = folder
        self._process = subprocess.Popen(
            [sys.executable, __file__, str(folder), json.dumps(settings)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            self._answer()
        except BaseException:
            self._process.kill()
            self.close()
            raise

    def set_scene(self, scene: str) -> None:
        """Set the scene from the next start of the stream on."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{scene}\n")
        self._process.stdin.flush()
        self._answer()

    def close(self) -> None:
        """End the process."""
        self._process.communicate()

    def _answer(self) -> None:
        assert self._process.stdout is not None
        answer = self._process.stdout.readline().strip()
        assert answer == "done", answer


@contextlib.contextmanager
def remote_bench(**settings: Any) -> Iterator[RemoteBench]:
    """Yield a bench with these ``BenchSettings`` in another process."""
    with short_folder() as folder:
        bench = RemoteBench(folder, settings)
        try:
            yield bench
        finally:
            bench.close()


def serve(folder: str, settings: str) -> None:
    """Serve the bench until standard input ends."""
    bench = Bench(BenchSettings(**json.loads(settings)))
    with serving(bench, Path(folder)):
        print("done", flush=True)
        for line in sys.stdin:
            bench.set_scene(line.strip())
            print("done", flush=True)


if __name__ == "__main__":
    serve(*sys.argv[1:])
