"""Commands that run all nodes in one process, with a log of the emulated generator's output."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

from waiting import wait_until

ROOT = Path(__file__).resolve().parents[2]
DEADLINE_S = 300.0
_LOGGED = """
import functools, sys
from eschorty_ros.nodes.one_process import calibration, composition
log, capture_s = sys.argv.pop(1), float(sys.argv.pop(1))
process = composition.bench_process
composition.bench_process = lambda folder, options: process(folder, {**options, "laser-log": log})
calibration.CalibrationJob = functools.partial(calibration.CalibrationJob, capture_s=capture_s)
from eschorty_ros.cli import main
main(prog_name="eschorty")
"""


class LoggedCommand:
    """`eschorty` with these arguments as a process, until the end of a ``with``."""

    def __init__(self, folder: Path, *arguments: object, capture_s: float = 1.0) -> None:
        self._log = folder / "laser.log"
        self.process = subprocess.Popen(
            [sys.executable, "-c", _LOGGED, str(self._log), str(capture_s), *map(str, arguments)],
            cwd=ROOT,
            env={name: value for name, value in os.environ.items() if name != "ROS_DOMAIN_ID"},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            # As a shell starts its background jobs: SIGINT must end the command even so.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),
        )

    def __enter__(self) -> LoggedCommand:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.communicate()

    def end(self) -> tuple[int, str, str]:
        stdout, stderr = self.process.communicate(timeout=DEADLINE_S)
        return self.process.returncode, stdout, stderr

    def outputs(self) -> list[str]:
        """``on`` and ``off`` in the order of the emulated generator's log."""
        if not self._log.exists():
            return []
        return re.findall(r"\b(on|off)\b", self._log.read_text().lower())

    def signal_when_on(self, number: signal.Signals) -> None:

        def on() -> bool:
            assert self.process.poll() is None, self.process.communicate()[1]
            return "on" in self.outputs()

        wait_until(on, "the laser on", DEADLINE_S, poll_s=0.05)
        self.process.send_signal(number)
