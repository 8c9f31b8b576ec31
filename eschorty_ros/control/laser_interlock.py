"""When the laser may be on: arming, interlock, leases, longest time on. No ROS, no device."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping

from eschorty_ros.control.peer import Peer, read_sign

LEASE = "laser/heartbeat"


class LaserGate:
    """Conditions for light, on a steady clock.

    Parameters
    ----------
    arm_timeout_s : float
        How long ``arm`` allows ``enable``.
    max_on_s : float
        Longest time on.
    leases : mapping of str to float
        Topics that must beat, and the age in seconds at which each one's last beat is stale. A
        sender on this host that dies or stands still, or says that it stops, is stale at once.
    interlock_timeout_s : float
        Age at which the last word that the interlock is closed counts no more: it is open then,
        and until the first one. Infinity: closed until somebody says otherwise.
    now_s : callable
        Steady clock in seconds.

    Attributes
    ----------
    gap_max_s : dict of str to float
        Longest time between two beats of each topic while on: tells what timeout is safe.
    """

    def __init__(
        self,
        arm_timeout_s: float,
        max_on_s: float,
        leases: Mapping[str, float],
        *,
        interlock_timeout_s: float = math.inf,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._arm_timeout_s = arm_timeout_s
        self._max_on_s = max_on_s
        self._leases = dict(leases)
        self._now_s = now_s
        self._armed_s: float | None = None
        self._beat_s: dict[str, float] = {}
        self._peers: dict[str, Peer | None] = {}
        self._stopped: set[str] = set()
        self._on_s: float | None = None
        self.gap_max_s: dict[str, float] = {}
        self._interlock_timeout_s = interlock_timeout_s
        self._said_open = False
        self._closed_s = -math.inf

    @property
    def interlock_open(self) -> bool:
        """Whether the interlock is said to be open, or nobody has said lately that it is not."""
        return self._said_open or self._now_s() - self._closed_s > self._interlock_timeout_s

    @interlock_open.setter
    def interlock_open(self, is_open: bool) -> None:
        self._said_open = is_open
        if not is_open:
            self._closed_s = self._now_s()

    @property
    def armed(self) -> bool:
        """Armed and not expired, or on."""
        armed_s = self._armed_s
        return self._on_s is not None or (
            armed_s is not None and self._now_s() - armed_s <= self._arm_timeout_s
        )

    @property
    def topics(self) -> tuple[str, ...]:
        """Topics that must beat."""
        return tuple(self._leases)

    def arm(self) -> None:
        """Allow ``enable`` for a while."""
        self._armed_s = self._now_s()

    def beat(self, topic: str = LEASE, sign: str = "") -> None:
        """Note that a heartbeat has arrived, and whose it is (see ``peer``)."""
        peer, stopped = read_sign(sign)
        if stopped:
            # Somebody else's end is no news: another one may beat on the same topic.
            if peer == self._peers.get(topic):
                self._stopped.add(topic)
            return
        self._peers[topic] = peer
        self._stopped.discard(topic)
        now_s = self._now_s()
        if self._on_s is not None and topic in self._beat_s:
            gap_s = now_s - self._beat_s[topic]
            self.gap_max_s[topic] = max(gap_s, self.gap_max_s.get(topic, 0.0))
        self._beat_s[topic] = now_s

    def forgive(self, pause_s: float) -> None:
        """Let no beat age by a time in which this process itself stood still."""
        now_s = self._now_s()
        for topic, beat_s in list(self._beat_s.items()):
            self._beat_s[topic] = min(beat_s + pause_s, now_s)

    def switched_on(self) -> None:
        """Note that the output has been switched on; asked again while on, its time runs on."""
        if self._on_s is None:
            self._on_s = self._now_s()

    def switched_off(self) -> None:
        """Note that the output has been switched off: disarmed too."""
        self._on_s = self._armed_s = None

    def refusal(self) -> str | None:
        """Why the laser must not be switched on now, ``None`` when it may."""
        if self._armed_s is None:
            return "not armed; call laser/arm first"
        if not self.armed:
            return f"arming expired after {self._arm_timeout_s:g} s; call laser/arm again"
        return self._unsafe()

    def must_end(self, at_s: float | None = None) -> str | None:
        """Why an output that is on must go off, ``None`` when it may stay.

        Beats are as old as they were at ``at_s`` of the clock, by default now.
        """
        on_s = self._on_s
        if on_s is None:
            return None
        if self._now_s() - on_s > self._max_on_s:
            return f"on for max_on_time, {self._max_on_s:g} s"
        return self._unsafe(at_s)

    def _unsafe(self, at_s: float | None = None) -> str | None:
        if self.interlock_open:
            return "interlock open; close it"
        at_s = self._now_s() if at_s is None else at_s
        for topic, timeout_s in self._leases.items():
            trouble = self._trouble(topic, timeout_s, at_s)
            if trouble:
                return f"{trouble}; {_remedy(topic)}"
        return None

    def _trouble(self, topic: str, timeout_s: float, at_s: float) -> str:
        beat_s = self._beat_s.get(topic)
        if beat_s is None:
            return f"no {topic}"
        if topic in self._stopped:
            return f"{topic} says stopped"
        if at_s - beat_s > timeout_s:
            return f"{topic} older than {timeout_s:g} s"
        peer = self._peers.get(topic)
        trouble = peer.trouble() if peer is not None else ""
        return f"{topic}: {trouble}" if trouble else ""


def _remedy(topic: str) -> str:
    if topic == LEASE:
        return "publish it while light is wanted"
    return f"look at the {topic.partition('/')[0]} node, or take it out of the parameter watch"
