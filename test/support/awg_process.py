"""An emulated generator in a process of its own, with its log as the evidence of light.

It does ``gone``, ``back``, ``mute``, ``speak``, ``replug``, ``reboot``, ``touch PATH TEXT``.
"""

import contextlib
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from command_process import CommandProcess, run_commands
from output_log import read_output_log
from short_folder import short_folder
from waiting import wait_until

from eschorty_ros.emulation.awg.model import AwgModel
from eschorty_ros.emulation.bus import UsbServer
from eschorty_ros.hardware.base.priority import DEVICE_NICE, raise_priority


class AwgProcess(CommandProcess):
    def __init__(self, log: Path, path: Path) -> None:
        self.log = log
        self.backend = f"eschorty_ros.emulation.bus.usb_remote:backend?{path}"
        super().__init__(__file__, path, log)

    def outputs(self) -> list[str]:
        """ON and OFF as the generator logged them."""
        return [output for _, output in read_output_log(self.log)]

    def lit(self) -> bool:
        return self.outputs()[-1] == "ON"

    def off_after_s(self, since_ns: int) -> float:
        """Return the time from ``since_ns`` (CLOCK_MONOTONIC) until the output was off, s."""
        wait_until(lambda: not self.lit(), "the output off", 60.0, 0.005)
        return (read_output_log(self.log)[-1][0] - since_ns) * 1e-9


@contextlib.contextmanager
def awg_process(folder: Path) -> Iterator[AwgProcess]:
    """Run a generator, with its log in ``folder``."""
    with short_folder() as bus, AwgProcess(folder / "generator.log", bus / "usb.sock") as made:
        yield made


def serve(path: str, log: str) -> None:
    raise_priority(DEVICE_NICE)
    model = AwgModel(time.monotonic_ns, log)

    def do(line: str) -> None:
        command, *arguments = line.split(maxsplit=2)
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

    def switch(name: str, value: bool) -> None:
        with model.mutex:
            setattr(model, name, value)

    with UsbServer(path, lambda: [model]):
        run_commands(do)


if __name__ == "__main__":
    serve(*sys.argv[1:])
