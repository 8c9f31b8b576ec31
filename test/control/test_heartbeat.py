"""When a node's heartbeat is due, and when it reports that its device stopped."""

import os
from collections.abc import Callable

import pytest

from eschorty_ros.control.heartbeat import (
    CHECK_S,
    LAST_HEARTBEATS,
    PERIOD_S,
    RECOVERY_CHECKS,
    HeartbeatSchedule,
    Sender,
    heartbeat_text,
    place,
    read_heartbeat,
)


def stops(
    healthy: Callable[[int], bool], checks: int, stall_at: int = 0, stall_s: float = 0.0
) -> list[int]:
    """Return the checks, from 1, whose heartbeat reports a stop."""
    schedule = HeartbeatSchedule()
    texts = {
        check: schedule.check(healthy(check), stall_s * (check == stall_at), check * CHECK_S)
        for check in range(1, checks + 1)
    }
    return [check for check, text in texts.items() if text and read_heartbeat(text)[1]]


def test_heartbeats_are_due_at_their_period():
    schedule = HeartbeatSchedule()
    quarter_s = 1.01 * PERIOD_S / 4.0
    sent = [n for n in range(100) if schedule.check(True, 0.0, n * quarter_s)]
    assert sent == list(range(0, 100, 4))


def test_device_that_fails_is_reported_at_once_and_three_times():
    reported = stops(lambda check: check < 10, 100)
    assert reported[0] == 10
    assert len(reported) == LAST_HEARTBEATS


@pytest.mark.parametrize(
    ("healthy", "stall_at", "first"),
    [
        (lambda check: not 10 <= check < 10 + RECOVERY_CHECKS, 10, None),
        (lambda check: check < 10, 10, 10 + RECOVERY_CHECKS),
        (lambda check: check < 10, 15, 10),
    ],
    ids=["read again in time", "not read again", "failed before the stall"],
)
def test_device_has_time_to_recover_from_a_stall_of_this_process(healthy, stall_at, first):
    assert (stops(healthy, 40, stall_at, 0.6) or [None])[0] == first


def test_texts_are_read_back():
    own = Sender(place(), os.getpid())
    assert read_heartbeat(heartbeat_text(stopped=False)) == (own, False)
    assert read_heartbeat(heartbeat_text(stopped=True)) == (own, True)
    assert own.fault() == ""
    for text in ("", "camera", "a b c d", "host x", "host 1 started", f"host {'9' * 5000}",
                 "host \u0661", f"{'x' * 201} 1", "host 1\n"):  # fmt: skip
        assert read_heartbeat(text) == (None, False)
