"""A cable between two network namespaces that loses frames at random, or is cut."""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import random
import selectors
import shutil
import struct
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

from command_process import CommandProcess, run_commands

SEED = 20261122
CLONE_NEWNET = 0x40000000
HOSTS = ("a", "b")
_TUNSETIFF, _IFF_TAP_NO_PI = 0x400454CA, 0x1002


def missing() -> str:
    """Return why such a link cannot be made here, ``""`` when it can."""
    if shutil.which("ip") is None:
        return "the command ip is missing; install iproute2"
    if not os.access("/dev/net/tun", os.W_OK):
        return "/dev/net/tun may not be opened; run as root"
    made = subprocess.run(["ip", "netns", "add", _space("probe")], capture_output=True, text=True)
    if made.returncode:
        return f"no network namespace may be made: {made.stderr.strip()}; run as root"
    _ip("netns", "del", _space("probe"))
    return ""


class TwoHosts:
    """Two network namespaces with a link between them; all ends with the ``with``."""

    def __init__(self) -> None:
        self._ending = contextlib.ExitStack()

    def __enter__(self) -> TwoHosts:
        for left in Path("/run/netns").glob(_space("*", "*")):
            if not Path("/proc", left.name.split("-")[1]).exists():
                _ip("netns", "del", left.name)
        with contextlib.ExitStack() as ending:
            spaces = [_space(host) for host in HOSTS]
            for space in spaces:
                _ip("netns", "add", space)
                ending.callback(_ip, "netns", "del", space)
            self._link = ending.enter_context(CommandProcess(__file__, *spaces))
            self._ending = ending.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.close()

    def lose(self, share: float) -> None:
        """Lose this share of the frames at random from now on; 1 cuts the link."""
        self._link.do(str(share))

    @contextlib.contextmanager
    def on(self, host: str) -> Iterator[None]:
        """Within it this thread, and what it starts, is on ``host``."""
        with open("/proc/thread-self/ns/net") as here:
            with open(f"/run/netns/{_space(host)}") as there:
                _enter(there.fileno())
            try:
                yield
            finally:
                _enter(here.fileno())


def _space(host: str, pid: object = "") -> str:
    return f"eschorty-{pid or os.getpid()}-{host}"


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)


def _enter(namespace: int) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.setns(namespace, CLONE_NEWNET):
        raise OSError(ctypes.get_errno(), "setns")


class _Link:
    """Carries frames between the ends in the two namespaces."""

    def __init__(self, spaces: list[str]) -> None:
        self.lost = 0.0
        self._random = random.Random(SEED)
        ends = [_end(space, number) for number, space in enumerate(spaces)]
        self._selector = selectors.DefaultSelector()
        for end, other in (ends, ends[::-1]):
            self._selector.register(end, selectors.EVENT_READ, other)

    def carry(self) -> None:
        while True:
            for key, _ in self._selector.select():
                frame = os.read(key.fd, 65536)
                if self._random.random() >= self.lost:
                    os.write(key.data, frame)


def _end(space: str, number: int) -> int:
    """One end of the link, with an address in its namespace."""
    name = f"esch{os.getpid() % 100_000}{HOSTS[number]}"
    end = os.open("/dev/net/tun", os.O_RDWR)
    fcntl.ioctl(end, _TUNSETIFF, struct.pack("16sH22x", name.encode(), _IFF_TAP_NO_PI))
    _ip("link", "set", name, "netns", space)
    _ip("-n", space, "addr", "add", f"10.99.0.{number + 1}/24", "dev", name)
    _ip("-n", space, "link", "set", name, "txqueuelen", "10000", "up")
    _ip("-n", space, "link", "set", "lo", "up")
    _ip("-n", space, "route", "add", "224.0.0.0/4", "dev", name)
    return end


def _main(spaces: list[str]) -> None:
    link = _Link(spaces)
    threading.Thread(target=link.carry, daemon=True).start()
    run_commands(lambda share: setattr(link, "lost", float(share)))


if __name__ == "__main__":
    _main(sys.argv[1:])
