"""A generator in a process of its own that writes down when it gives light, and its driver.

``python generator_double.py SOCKET LOG`` serves one client at a time, as a claimed USB device
does, and keeps its output when the client goes, as a generator does. The log gets a line
``<CLOCK_MONOTONIC ns> ON|OFF`` at every change.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from short_folder import short_folder
from waiting import DEADLINE_S, wait_until

from eschorty_ros.core.base.errors import DeviceError, DeviceGoneError
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.hardware.base.protocols import DeviceIdentity, LaserOutput, LaserReadback

MAKE = "generator_double:GeneratorLaser"
_INTERRUPTED = "the generator's settings: switched off meanwhile"
# Said where a generator says nothing: a time-out without the time.
_MUTE = "mute"


class GeneratorLaser:
    """Driver: every operation is a number of transfers, ``disable`` waits for one at most.

    With ``held``, reading back makes that file, then waits until switching off interrupts it.
    """

    def __init__(self, path: str, held: str = "", crash: str = "") -> None:
        self.identity = DeviceIdentity("generator double", "42")
        self._held = held
        self._crash = crash
        self._lock = threading.Lock()
        self._off_wanted = 0
        self._armed = False
        self._modulation = Modulation(70.0)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.settimeout(DEADLINE_S)
        try:
            self._socket.connect(path)
            if self._transfer("CLAIM") != "ok":
                raise DeviceError("the generator is busy; close the other program")
            self._transfer("OFF")
        except OSError as error:
            self._socket.close()
            raise DeviceGoneError(f"no generator ({error}); connect it") from error
        except DeviceError:
            self._socket.close()
            raise

    def configure(self, modulation: Modulation) -> None:
        self._commands("NOP", "NOP", "NOP")
        self._modulation = modulation

    def arm(self) -> None:
        self._armed = True

    def enable(self) -> None:
        with self._lock:
            if not self._armed:
                raise DeviceError("the laser is not armed; arm it before enabling the output")
            self._armed = False
            self._transfer("ON")

    def disable(self) -> None:
        self._off_wanted += 1
        try:
            with self._lock:
                self._armed = False
                self._transfer("OFF")
        finally:
            self._off_wanted -= 1

    def readback(self) -> LaserReadback:
        if self._crash:
            os._exit(7)
        if self._held:
            self._wait_for_interruption()
        output = self._commands("READ", "READ")
        return LaserReadback(LaserOutput[output], self._modulation, None, 0)

    def close(self) -> None:
        with contextlib.suppress(DeviceError):
            self.disable()
            # Answered: whoever opens it next finds it free.
            with self._lock:
                self._transfer("RELEASE")
        self._socket.close()

    def _wait_for_interruption(self) -> None:
        # Interrupted while it has the lock: once it is free, switching off may be over unseen.
        with self._lock:
            Path(self._held).touch()
            while not self._off_wanted:
                time.sleep(0.002)
            raise DeviceError(_INTERRUPTED)

    def _commands(self, *commands: str) -> str:
        answer = ""
        with self._lock:
            for command in commands:
                if self._off_wanted:
                    raise DeviceError(_INTERRUPTED)
                answer = self._transfer(command)
        return answer

    def _transfer(self, command: str) -> str:
        try:
            self._socket.send(command.encode())
            answer = self._socket.recv(64).decode()
        except OSError as error:
            raise DeviceGoneError(f"the generator is gone ({error}); connect it") from error
        if answer in ("", _MUTE):
            raise DeviceGoneError("the generator is gone; connect it")
        return answer


class Generator:
    """The generator's process, its log, and somebody at its front panel."""

    def __init__(self, folder: Path) -> None:
        self._held = contextlib.ExitStack()
        self.path = self._held.enter_context(short_folder()) / "generator.sock"
        self.log = folder / "generator.log"
        self.settings = {"path": str(self.path)}
        self.process = subprocess.Popen([sys.executable, __file__, str(self.path), str(self.log)])
        try:
            wait_until(self._there, "the generator", poll_s=0.005)
        except BaseException:
            self.close()
            raise

    def lines(self) -> list[tuple[int, str]]:
        """Times (CLOCK_MONOTONIC, ns) and ON or OFF."""
        rows = (line.split() for line in self.log.read_text().splitlines())
        return [(int(t_ns), output) for t_ns, output in rows]

    def lit(self) -> bool:
        """Whether there is light now."""
        return self.lines()[-1][1] == "ON"

    def off_after_s(self, since_ns: int, patience_s: float = 60.0) -> float:
        """How long after ``since_ns`` the light went off."""
        end_s = time.monotonic() + patience_s
        while self.lit():
            assert time.monotonic() < end_s, f"still lit after {patience_s:g} s"
            time.sleep(0.005)
        return (self.lines()[-1][0] - since_ns) * 1e-9

    def press(self, command: str) -> None:
        """Do at the panel what ``command`` says: ON, OFF, MUTE, SPEAK."""
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as panel:
            panel.connect(str(self.path))
            panel.send(f"PANEL {command}".encode())
            panel.recv(64)

    def _there(self) -> bool:
        assert self.process.poll() is None, f"exit code {self.process.returncode}"
        return self.path.exists()

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        self._held.close()


@contextlib.contextmanager
def generator(folder: Path) -> Iterator[Generator]:
    """A generator of its own."""
    made = Generator(folder)
    try:
        yield made
    finally:
        made.close()


def serve(path: str, log: str) -> None:
    """Be the generator."""
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    lock = threading.Lock()
    state = {"output": "OFF", "mute": False, "claimed": None}

    def change(output: str) -> None:
        if state["output"] != output or not Path(log).exists():
            state["output"] = output
            with open(log, "a", encoding="ascii") as stream:
                stream.write(f"{time.monotonic_ns()} {output}\n")

    def carry_out(client: socket.socket, command: str) -> str:
        panel = command.startswith("PANEL ")
        command = command.removeprefix("PANEL ")
        if not panel and state["mute"]:
            return _MUTE
        if command in ("ON", "OFF"):
            change(command)
        elif command in ("MUTE", "SPEAK"):
            state["mute"] = command == "MUTE"
        elif command == "CLAIM":
            if state["claimed"] is not None:
                return "busy"
            state["claimed"] = client
        elif command == "RELEASE":
            if state["claimed"] is client:
                state["claimed"] = None
        elif command == "READ":
            return str(state["output"])
        return "ok"

    def talk(client: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while command := client.recv(64).decode():
                with lock:
                    answer = carry_out(client, command)
                client.send(answer.encode())
        with lock:
            if state["claimed"] is client:
                state["claimed"] = None
        client.close()

    change("OFF")
    listener.bind(path + ".new")
    listener.listen()
    os.rename(path + ".new", path)
    while True:
        client, _ = listener.accept()
        threading.Thread(target=talk, args=(client,), daemon=True).start()


if __name__ == "__main__":
    serve(*sys.argv[1:])
