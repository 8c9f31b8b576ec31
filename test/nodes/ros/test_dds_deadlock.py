"""Threads of DDS that wait for each other are found; those that only have nothing to do are not."""

import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from eschorty_ros.nodes.ros import dds_deadlock
from eschorty_ros.nodes.ros.dds_deadlock import DdsDeadlock, DdsDeadlockError


class DdsThread:
    """A thread with the name of one that receives; it reads when it is to."""

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.reads, self.has_read = threading.Semaphore(0), threading.Semaphore(0)
        named = threading.Event()
        threading.Thread(target=self._run, args=(named,), daemon=True).start()
        named.wait()
        # Until it blocks it still runs now and then.
        time.sleep(0.1)

    def _run(self, named: threading.Event) -> None:
        Path(f"/proc/self/task/{threading.get_native_id()}/comm").write_text("dds.udp.7400")
        named.set()
        while self.reads.acquire():
            self.socket.recv(10)
            self.has_read.release()

    def receive(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(b"message", self.socket.getsockname())

    def read(self) -> None:
        self.reads.release()
        assert self.has_read.acquire(timeout=10.0)


@pytest.fixture
def thread() -> Iterator[DdsThread]:
    thread = DdsThread()
    yield thread
    thread.receive()
    thread.read()
    thread.socket.close()


@pytest.fixture
def seconds(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Give thirty seconds, one after the other."""
    now_s = [0.0]
    monkeypatch.setattr(dds_deadlock, "time", SimpleNamespace(monotonic=lambda: now_s[0]))

    def pass_by() -> Iterator[int]:
        for second in range(30):
            now_s[0] += 1.0
            yield second

    return pass_by()


def look_on(seconds: Iterator[int]) -> None:
    watch = DdsDeadlock()
    for _ in seconds:
        watch.look()


def test_messages_that_no_thread_takes_are_a_deadlock(thread, seconds):
    thread.receive()
    with pytest.raises(DdsDeadlockError, match="start the node again"):
        look_on(seconds)
    assert next(seconds) < 13


def test_no_messages_are_no_deadlock(thread, seconds):
    look_on(seconds)


def test_messages_that_are_taken_at_times_are_no_deadlock(thread, seconds):
    watch = DdsDeadlock()
    thread.receive()
    for second in seconds:
        watch.look()
        if second % 8 == 0:
            thread.receive()
            thread.read()


def test_a_stopped_process_is_no_deadlock(thread, seconds):
    watch = DdsDeadlock()
    thread.receive()
    for second in seconds:
        if second < 3 or second > 26:
            watch.look()
