"""A process that carries out a test's commands."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable


class CommandProcess:
    """``python FILE ARGUMENTS``, which calls ``run_commands``; ends with the ``with``."""

    def __init__(self, file: str, *arguments: object) -> None:
        command = [sys.executable, file, *map(str, arguments)]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def __enter__(self) -> CommandProcess:
        try:
            self._answer()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()

    def do(self, command: str) -> None:
        """Give a command; done when this returns."""
        print(command, file=self._process.stdin, flush=True)
        self._answer()

    def _answer(self) -> None:
        answer = self._process.stdout.readline().strip()
        assert answer == "done", answer


def run_commands(do: Callable[[str], object]) -> None:
    """In the process: carry out the lines of standard input, until it ends."""
    print("done", flush=True)
    for line in sys.stdin:
        do(line.strip())
        print("done", flush=True)
