"""The conditions under which the laser may be on: arming, contacts, heartbeats, longest time on."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass

from eschorty_ros.control.heartbeat import Sender, read_heartbeat

CLIENT_HEARTBEAT = "laser/heartbeat"
_KEPT = 16
"""Senders of one topic, and sources of the contact, that are kept: the newest."""

_Identity = tuple[str, Sender | None]


@dataclass(slots=True)
class _Heartbeat:
    received_s: float
    stopped: bool = False


class LaserInterlock:
    """Decides on a steady clock whether the laser may be enabled and whether it must be disabled.

    While the laser is on, each heartbeat counts only from the sender that had it enabled. An opened
    contact stays open until ``reset_contact``, even when it is reported closed later.

    - ``arm_timeout_s``: How long ``arm`` allows enabling.
    - ``max_on_s``: Longest time on.
    - ``timeouts_s``: Heartbeat topics that must be fresh, and the age in seconds at which each one
      is stale. A heartbeat that reports a stop is stale at once, as is one whose sender runs on
      this host and ends or is stopped.
    - ``contact_timeout_s``: Age at which a source's report of the closed contact expires: it counts
      as open then.
    - ``contact_required``: Whether the contact counts as open before any source reports it closed.
    - ``now_s``: Steady clock in seconds.

    Public attributes:
    - ``gap_max_s``: Longest time between two heartbeats of each topic while on; a timeout below it
      would trip.
    - ``foreign_heartbeats``: Heartbeats of other senders than those that had the laser enabled.
    """

    def __init__(
        self,
        arm_timeout_s: float,
        max_on_s: float,
        timeouts_s: Mapping[str, float],
        *,
        contact_timeout_s: float = 1.0,
        contact_required: bool = False,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._arm_timeout_s = arm_timeout_s
        self._max_on_s = max_on_s
        self._timeouts_s = dict(timeouts_s)
        self._contact_timeout_s = contact_timeout_s
        self._contact_required = contact_required
        self._now_s = now_s
        # An opening that comes while the latch is reset must stay latched.
        self._contact_lock = threading.Lock()
        # Time of the last report of closed by source, ``None`` after one of open.
        self._closed_s: dict[str, float | None] = {}
        self._nameless: set[str] = set()
        self._opened_by = ""
        self._armed_s: float | None = None
        self._on_s: float | None = None
        self._heartbeats: dict[str, dict[_Identity, _Heartbeat]] = {t: {} for t in timeouts_s}
        self._owners: dict[str, _Identity] = {}
        self.gap_max_s: dict[str, float] = {}
        self.foreign_heartbeats = 0

    @property
    def contact_open(self) -> bool:
        """Return whether the contact is open, was opened since the last reset, or has expired."""
        return self.contact_fault() != ""

    @property
    def armed(self) -> bool:
        """Return whether it is on, or armed and the arming has not expired."""
        armed_s = self._armed_s
        return self._on_s is not None or (
            armed_s is not None and self._now_s() - armed_s <= self._arm_timeout_s
        )

    @property
    def topics(self) -> tuple[str, ...]:
        """Return the heartbeat topics that must be fresh."""
        return tuple(self._timeouts_s)

    def arm(self) -> None:
        """Allow enabling for a while."""
        self._armed_s = self._now_s()

    def receive_contact(self, is_open: bool, source: str = "", unnamed: str = "") -> None:
        """Take a source's report of the contact; every source counts from its first report on.

        ``unnamed`` is the source of its reports before its name was known.
        """
        with self._contact_lock:
            if unnamed and unnamed != source:
                self._closed_s.pop(unnamed, None)
                self._nameless.discard(unnamed)
            elif unnamed and len(self._nameless) < _KEPT:
                self._nameless.add(unnamed)
            if is_open:
                self._opened_by = source or "laser/interlock"
            if is_open or source in self._closed_s or len(self._closed_s) < _KEPT:
                self._closed_s[source] = None if is_open else self._now_s()

    def reset_contact(self, present: Collection[str]) -> str:
        """Undo the latch of an opened contact; return why that is refused, ``""`` when it is not.

        It is while a source reports it open, or its report of closed has expired. A source whose
        name never became known, and that is not among the ``present`` any more, cannot report
        closed: it is dropped.
        """
        with self._contact_lock:
            for source in self._nameless.difference(present):
                self._closed_s.pop(source, None)
                self._nameless.discard(source)
            fault = self._source_fault()
            if not fault:
                self._opened_by = ""
            return fault

    def contact_fault(self) -> str:
        """Return why the contact counts as open, ``""`` while it is closed."""
        fault = self._source_fault()
        if self._opened_by and not fault:
            return f"interlock was opened ({self._opened_by}); call laser/reset_interlock"
        return fault

    def receive_heartbeat(
        self, topic: str = CLIENT_HEARTBEAT, text: str = "", publisher: str = ""
    ) -> None:
        """Take a heartbeat with its text (see ``heartbeat_text``) and its publisher's id."""
        sender, stopped = read_heartbeat(text)
        identity, heartbeats = (publisher, sender), self._heartbeats[topic]
        known = heartbeats.get(identity)
        owner = self._owners.get(topic, identity)
        if owner != identity:
            self.foreign_heartbeats += 1
        if stopped:
            if known is not None:
                known.stopped = True
            return
        now_s = self._now_s()
        if self._on_s is not None and known is not None and owner == identity:
            gap_s = now_s - known.received_s
            self.gap_max_s[topic] = max(gap_s, self.gap_max_s.get(topic, 0.0))
        # The newest last; other senders, however many, never displace the owner.
        kept = {key: heartbeats[key] for key in list(heartbeats)[1 - _KEPT :] if key != identity}
        if owner in heartbeats:
            kept[owner] = heartbeats[owner]
        self._heartbeats[topic] = {**kept, identity: _Heartbeat(now_s)}

    def exclude_stall(self, stall_s: float) -> None:
        """Exclude a stall of this process from the age of every heartbeat."""
        now_s = self._now_s()
        for heartbeats in self._heartbeats.values():
            for heartbeat in list(heartbeats.values()):
                heartbeat.received_s = min(heartbeat.received_s + stall_s, now_s)

    def note_enabled(self) -> None:
        """Note that the output is enabled; when it already is, its time on runs on."""
        if self._on_s is None:
            now_s = self._on_s = self._now_s()
            self._owners = {
                topic: identity for topic in self.topics for identity in self._fresh(topic, now_s)
            }

    def note_disabled(self) -> None:
        """Note that the output is disabled; disarms."""
        self._on_s = self._armed_s = None
        self._owners = {}

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

    def _source_fault(self) -> str:
        now_s = self._now_s()
        for source, closed_s in list(self._closed_s.items()):
            name = f" ({source})" if source else ""
            if closed_s is None:
                return f"interlock open{name}; close it"
            if now_s - closed_s > self._contact_timeout_s:
                return (
                    f"interlock open{name}: closed was last reported more than "
                    f"{self._contact_timeout_s:g} s ago; repeat it"
                )
        if self._contact_required and not self._closed_s:
            return "interlock open: no report of closed on laser/interlock; close it"
        return ""

    def _unsafe(self, at_s: float) -> str | None:
        fault = self.contact_fault()
        if fault:
            return fault
        for topic in self._timeouts_s:
            fault = self._heartbeat_fault(topic, at_s)
            if fault:
                return f"{fault}; {_remedy(topic)}"
        return None

    def _fresh(self, topic: str, at_s: float) -> Iterator[_Identity]:
        for identity, heartbeat in list(self._heartbeats[topic].items()):
            if not self._fault_of(topic, identity, heartbeat, at_s):
                yield identity

    def _heartbeat_fault(self, topic: str, at_s: float) -> str:
        heartbeats = self._heartbeats[topic]
        if not heartbeats:
            return f"no {topic}"
        owner = self._owners.get(topic)
        if owner is None:
            fresh = len(list(self._fresh(topic, at_s)))
            if fresh > 1:
                return f"{topic} comes from {fresh} senders at once"
            if fresh == 1:
                return ""
            owner = next(reversed(heartbeats))
        return self._fault_of(topic, owner, heartbeats[owner], at_s)

    def _fault_of(self, topic: str, identity: _Identity, heartbeat: _Heartbeat, at_s: float) -> str:
        timeout_s, sender = self._timeouts_s[topic], identity[1]
        if heartbeat.stopped:
            return f"{topic} reports stopped"
        if at_s - heartbeat.received_s > timeout_s:
            return f"{topic} older than {timeout_s:g} s"
        fault = sender.fault() if sender is not None else ""
        return f"{topic}: {fault}" if fault else ""


def _remedy(topic: str) -> str:
    if topic == CLIENT_HEARTBEAT:
        return "publish it while light is requested"
    return f"look at the {topic.partition('/')[0]} node, or take it out of the parameter watch"
