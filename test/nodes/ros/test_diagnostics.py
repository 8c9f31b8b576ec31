"""What every node adds to its own report on ``/diagnostics``."""

from types import SimpleNamespace

import pytest
from std_msgs.msg import Header

from eschorty_ros.nodes.ros import diagnostics
from eschorty_ros.nodes.ros.border import refusals


@pytest.fixture
def made(monkeypatch):
    """A function that makes the diagnostics of a report at a time: they, node, what is sent."""
    monkeypatch.setattr(diagnostics, "steady_timer", lambda *_: None)

    def make(*report, now_ns=1):
        sent = []
        now = SimpleNamespace(to_msg=lambda: Header().stamp, nanoseconds=now_ns)
        node = SimpleNamespace(
            create_publisher=lambda *_: SimpleNamespace(publish=sent.append),
            get_logger=lambda: SimpleNamespace(error=lambda _: None),
            get_fully_qualified_name=lambda: "/eschorty/node",
            get_clock=lambda: SimpleNamespace(now=lambda: now),
        )
        return diagnostics.Diagnostics(node, lambda: (*report, {})), node, sent

    return make


@pytest.mark.parametrize(
    ("level", "shown"),
    [(diagnostics.OK, diagnostics.WARN), (diagnostics.WARN, diagnostics.WARN),
     (diagnostics.ERROR, diagnostics.ERROR)],
)  # fmt: skip
def test_refused_messages_are_reported_once_with_the_reason_of_the_last(made, level, shown):
    subject, node, sent = made(level, "at work")
    for reason in ("encoding is evt2", "encoding is evt21"):
        refusals(node).add("camera/events", reason)
    subject.publish()
    subject.publish()
    first, second = (message.status[0] for message in sent)
    assert first.level == shown
    assert first.message == (
        "at work; 2 messages were refused in the last second, the last of camera/events: "
        "encoding is evt21"
    )
    assert (second.level, second.message) == (level, "at work")


def test_simulated_time_without_a_clock_is_reported(made):
    subject, _, sent = made(diagnostics.OK, "no packets yet", now_ns=0)
    subject.publish()
    status = sent[0].status[0]
    assert status.level == diagnostics.WARN
    assert status.message.startswith(
        "no packets yet; use_sim_time is true and nothing is on /clock"
    )
