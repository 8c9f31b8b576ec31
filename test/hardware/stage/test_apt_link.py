"""The link on a port that fails."""

import errno
import threading
import time

import pytest
from waiting import DEADLINE_S

from eschorty_ros.core.base.errors import DeviceError, DeviceGoneError
from eschorty_ros.hardware.stage.apt_link import AptLink


class SilentPort:
    timeout: float | None = None
    in_waiting = 0

    def read(self, size: int = 1) -> bytes:
        return b""

    def write(self, data: bytes) -> int:
        return len(data)

    def close(self) -> None:
        pass


class DeadPort(SilentPort):
    def write(self, data: bytes) -> int:
        raise OSError(errno.EIO, "Input/output error")


def test_the_link_can_be_used_while_its_failure_is_handled() -> None:
    """The reader may request a status while ``on_lost`` waits for its lock."""
    failures: list[DeviceError] = []

    def on_lost(error: DeviceError) -> None:
        reader = threading.Thread(target=link.write, args=(b"again",), daemon=True)
        reader.start()
        reader.join(DEADLINE_S)
        assert not reader.is_alive()
        failures.append(error)

    link = AptLink(DeadPort(), lambda frame, at_ns: None, on_lost)
    link.write(b"frame")
    assert [str(error) for error in failures] == [
        "the stage's port failed: [Errno 5] Input/output error; check the cable, then configure "
        "again"
    ]
    with pytest.raises(DeviceGoneError, match="port failed"):
        link.send(b"frame")


def test_a_request_that_cannot_be_sent_leaves_nothing_behind() -> None:
    link = AptLink(DeadPort(), lambda frame, at_ns: None, lambda error: None)
    link.close()
    with pytest.raises(DeviceGoneError, match="port is closed"):
        link.request(b"frame", "info", 0x50, 1.0)
    assert not link._answers


@pytest.mark.parametrize("reading", [1, 2])
def test_an_action_that_is_added_just_before_the_writer_waits_begins_at_once(reading: int) -> None:
    begun = threading.Event()
    readings = 0

    def now_ns() -> int:
        """Add the action while the writer reads the clock for the ``reading``-th time."""
        nonlocal readings
        if threading.current_thread().name == "apt writer":
            readings += 1
            if readings == reading:
                link.call_every(lambda: 1e6, begun.set)
        return time.monotonic_ns()

    link = AptLink(SilentPort(), lambda frame, at_ns: None, lambda error: None, now_ns)
    link.call_every(lambda: 1e6, lambda: None)
    link.start()
    try:
        assert begun.wait(DEADLINE_S)
    finally:
        link.close()
