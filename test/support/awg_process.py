"""An emulated generator in a process of its own, with its log as the evidence of light.

``python awg_process.py SOCKET LOG`` serves it on an emulated bus and does what comes on standard
input: ``gone``, ``back``, ``mute``, ``speak``, ``replug``, ``reboot``, ``touch PATH TEXT``.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from short_folder import short_folder

from eschorty_ros.emulation.awg.model import AwgModel, read_output_log
from eschorty_ros.emulation.bus import UsbServer


class AwgProcess:
    """The running generator, until the end of a ``with``; it ends with the tests, too."""

    def __init__(self, folder: Path) -> None:
        self.log = folder / "generator.log"
        with contextlib.ExitStack() as held:
            path = held.enter_context(short_folder()) / "usb.sock"
            self.backend = f"eschorty_ros.emulation.bus.usb_remote:backend?{path}"
            self._process = subprocess.Popen(
                [sys.executable, __file__, str(path), str(self.log)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            held.callback(self._end)
            self._answer()
            self._held = held.pop_all()

    def __enter__(self) -> AwgProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self._held.close()

    def do(self, command: str) -> None:
        """Make the generator fail, or touch its panel; done when this returns."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{command}\n")
        self._process.stdin.flush()
        self._answer()

    def outputs(self) -> list[str]:
        """ON and OFF as the generator logged them."""
        return [output for _, output in read_output_log(self.log)]

    def lit(self) -> bool:
        """Whether the output is on now."""
        return self.outputs()[-1] == "ON"

    def off_after_s(self, since_ns: int, deadline_s: float = 60.0) -> float:
        """How long after ``since_ns`` (CLOCK_MONOTONIC) the output was switched off."""
        end_s = time.monotonic() + deadline_s
        while self.lit():
            assert time.monotonic() < end_s, f"still on after {deadline_s:g} s"
            time.sleep(0.005)
        return (read_output_log(self.log)[-1][0] - since_ns) * 1e-9

    def _end(self) -> None:
        self._process.kill()
        self._process.communicate()

    def _answer(self) -> None:
        assert self._process.stdout is not None
        answer = self._process.stdout.readline().strip()
        assert answer == "done", answer


def serve(path: str, log: str) -> None:
    """Be the generator."""
    model = AwgModel(time.monotonic_ns, log)
    models = [model]

    def switch(name: str, value: Any) -> None:
        with model.mutex:
            setattr(model, name, value)

    with UsbServer(path, lambda: models):
        print("done", flush=True)
        for line in sys.stdin:
            command, *arguments = line.strip().split(maxsplit=2)
            match command:
                case "gone" | "back":
                    switch("gone", command == "gone")
                case "mute" | "speak":
                    switch("mute", command == "mute")
                case "touch":
                    # The panel is only free between transactions.
                    while not model.touch(*arguments):
                        time.sleep(0.001)
                case _:
                    getattr(model, command)()
            print("done", flush=True)


if __name__ == "__main__":
    serve(*sys.argv[1:])
