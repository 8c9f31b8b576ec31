"""The conditions under which the laser may be on: arming, contact, heartbeats, longest time on."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping

from eschorty_ros.control.heartbeat import Sender, read_heartbeat

CLIENT_HEARTBEAT = "laser/heartbeat"


class LaserInterlock:
    """Decides on a steady clock whether the laser may be enabled and whether it must be disabled.

    Parameters
    ----------
    arm_timeout_s : float
        How long ``arm`` allows enabling.
    max_on_s : float
        Longest time on.
    timeouts_s : mapping of str to float
        Heartbeat topics that must be fresh, and the age in seconds at which each one is stale. A
        heartbeat that reports a stop is stale at once, as is one whose sender runs on this host and
        dies or is stopped.
    contact_timeout_s : float
        Age at which a report of the closed contact expires: the contact counts as open then, and
        before the first report. Infinity: it counts as closed until it is reported open.
    now_s : callable
        Steady clock in seconds.

    Attributes
    ----------
    gap_max_s : dict of str to float
        Longest time between two heartbeats of each topic while on; a timeout below it would trip.
    """

    def __init__(
        self,
        arm_timeout_s: float,
        max_on_s: float,
        timeouts_s: Mapping[str, float],
        *,
        contact_timeout_s: float = math.inf,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._arm_timeout_s = arm_timeout_s
        self._max_on_s = max_on_s
        self._timeouts_s = dict(timeouts_s)
        self._contact_timeout_s = contact_timeout_s
        self._now_s = now_s
        self._reported_open = False
        self._closed_s = -math.inf
        self._armed_s: float | None = None
        self._on_s: float | None = None
        self._received_s: dict[str, float] = {}
        self._senders: dict[str, Sender | None] = {}
        self._stopped: set[str] = set()
        self.gap_max_s: dict[str, float] = {}

    @property
    def contact_open(self) -> bool:
        """Return whether the contact is reported open, or its report of closed has expired."""
        return self._reported_open or self._now_s() - self._closed_s > self._contact_timeout_s

    @property
    def armed(self) -> bool:
        """Armed and not expired, or on."""
        armed_s = self._armed_s
        return self._on_s is not None or (
            armed_s is not None and self._now_s() - armed_s <= self._arm_timeout_s
        )

    @property
    def topics(self) -> tuple[str, ...]:
        """Heartbeat topics that must be fresh."""
        return tuple(self._timeouts_s)

    def arm(self) -> None:
        """Allow enabling for a while."""
        self._armed_s = self._now_s()

    def receive_contact(self, is_open: bool) -> None:
        """Take a report of the contact."""
        self._reported_open = is_open
        if not is_open:
            self._closed_s = self._now_s()

    def receive_heartbeat(self, topic: str = CLIENT_HEARTBEAT, text: str = "") -> None:
        """Take a heartbeat with its text (see ``heartbeat_text``)."""
        sender, stopped = read_heartbeat(text)
        if stopped:
            # Two processes may send on one topic; only the last sender's stop counts.
            if sender == self._senders.get(topic):
                self._stopped.add(topic)
            return
        self._senders[topic] = sender
        self._stopped.discard(topic)
        now_s = self._now_s()
        if self._on_s is not None and topic in self._received_s:
            gap_s = now_s - self._received_s[topic]
            self.gap_max_s[topic] = max(gap_s, self.gap_max_s.get(topic, 0.0))
        self._received_s[topic] = now_s

    def exclude_stall(self, stall_s: float) -> None:
        """Exclude a stall of this process from the age of every heartbeat."""
        now_s = self._now_s()
        for topic, received_s in list(self._received_s.items()):
            self._received_s[topic] = min(received_s + stall_s, now_s)

    def note_enabled(self) -> None:
        """Note that the output is enabled; when it already is, its time on runs on."""
        if self._on_s is None:
            self._on_s = self._now_s()

    def note_disabled(self) -> None:
        """Note that the output is disabled; disarms."""
        self._on_s = self._armed_s = None

    def refusal(self) -> str | None:
        """Return why the laser must not be enabled now, ``None`` when it may."""
        if self._armed_s is None:
            return "not armed; call laser/arm first"
        if not self.armed:
            return f"arming expired after {self._arm_timeout_s:g} s; call laser/arm again"
        return self._unsafe(self._now_s())

    def trip_reason(self, at_s: float | None = None) -> str | None:
        """Return why an output that is on must be disabled, ``None`` when it may stay on.

        Heartbeats are as old as they were at ``at_s`` of the clock, by default now.
        """
        now_s = self._now_s()
        if self._on_s is None:
            return None
        if now_s - self._on_s > self._max_on_s:
            return f"on for max_on_time, {self._max_on_s:g} s"
        return self._unsafe(now_s if at_s is None else at_s)

    def _unsafe(self, at_s: float) -> str | None:
        if self.contact_open:
            return "interlock open; close it"
        for topic, timeout_s in self._timeouts_s.items():
            fault = self._heartbeat_fault(topic, timeout_s, at_s)
            if fault:
                return f"{fault}; {_remedy(topic)}"
        return None

    def _heartbeat_fault(self, topic: str, timeout_s: float, at_s: float) -> str:
        received_s = self._received_s.get(topic)
        if received_s is None:
            return f"no {topic}"
        if topic in self._stopped:
            return f"{topic} reports stopped"
        if at_s - received_s > timeout_s:
            return f"{topic} older than {timeout_s:g} s"
        sender = self._senders.get(topic)
        fault = sender.fault() if sender is not None else ""
        return f"{topic}: {fault}" if fault else ""


def _remedy(topic: str) -> str:
    if topic == CLIENT_HEARTBEAT:
        return "publish it while light is requested"
    return f"look at the {topic.partition('/')[0]} node, or take it out of the parameter watch"
