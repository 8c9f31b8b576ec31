"""When the laser may be on: arming, interlock, heartbeat, longest time on. No ROS, no device."""

from __future__ import annotations

import time
from collections.abc import Callable


class LaserGate:
    """Conditions for light, on a steady clock.

    Parameters
    ----------
    arm_timeout_s : float
        How long ``arm`` allows ``enable``.
    heartbeat_timeout_s : float
        Age at which the heartbeat is stale.
    max_on_s : float
        Longest time on.
    now_s : callable
        Steady clock in seconds.
    """

    def __init__(
        self,
        arm_timeout_s: float,
        heartbeat_timeout_s: float,
        max_on_s: float,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._arm_timeout_s = arm_timeout_s
        self._heartbeat_timeout_s = heartbeat_timeout_s
        self._max_on_s = max_on_s
        self._now_s = now_s
        self._armed_s: float | None = None
        self._heartbeat_s: float | None = None
        self._on_s: float | None = None
        self.interlock_open = False

    @property
    def armed(self) -> bool:
        """Armed and not expired, or on."""
        return self._on_s is not None or (
            self._armed_s is not None and self._now_s() - self._armed_s <= self._arm_timeout_s
        )

    def arm(self) -> None:
        """Allow ``enable`` for a while."""
        self._armed_s = self._now_s()

    def beat(self) -> None:
        """Note that a heartbeat has arrived."""
        self._heartbeat_s = self._now_s()

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

    def must_end(self) -> str | None:
        """Why an output that is on must go off now, ``None`` when it may stay."""
        if self._on_s is None:
            return None
        if self._now_s() - self._on_s > self._max_on_s:
            return f"on for max_on_time, {self._max_on_s:g} s"
        return self._unsafe()

    def _unsafe(self) -> str | None:
        if self.interlock_open:
            return "interlock open; close it"
        if self._heartbeat_s is None:
            return "no heartbeat; publish laser/heartbeat while light is wanted"
        if self._now_s() - self._heartbeat_s > self._heartbeat_timeout_s:
            return (
                f"heartbeat older than {self._heartbeat_timeout_s:g} s; "
                "publish laser/heartbeat while light is wanted"
            )
        return None
