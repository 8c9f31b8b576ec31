"""Waiting in ticks; every tick gives feedback and checks each reason to end."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator

from eschorty_ros.control.instrument_monitor import InstrumentMonitor
from eschorty_ros.control.scan_sequence import ScanCanceled, ScanFailure

_TICK_S = 0.02
_NOTED_S = 0.5
# After a longer stall of this process the others seem to report no longer.
_STALL_S = 2.5
# The pace of a reconstruction that gets its events in lumps is known after this time.
_PACE_KNOWN_S = 5.0


class PacedWaiting:
    """The waits of one sequence, which can be watched, canceled and ended.

    Its methods block, so they run in a thread of their own.

    - ``name``: Name of the program that waits, for messages.
    - ``now_ns``: The clock that stamps the events.
    - ``running``: Returns whether the program continues.
    - ``events_timeout_s``: Longest time without progress of the reconstruction while watching.

    Public attributes:
    - ``waits_for``: What a wait of more than half a second lacks, ``""`` otherwise.
    """

    def __init__(
        self,
        name: str,
        monitor: InstrumentMonitor,
        now_ns: Callable[[], int],
        running: Callable[[], bool],
        events_timeout_s: float,
    ) -> None:
        self.monitor = monitor
        self._name = name
        self._now_ns = now_ns
        self._running = running
        self._events_timeout_s = events_timeout_s
        self._tick_s = 0.0
        self._ended = threading.Event()
        self._watching = False
        self._shielded = False
        self._canceled: Callable[[], bool] = lambda: False
        self._feedback: Callable[[str], None] = lambda phase: None
        self._phase = ""
        self.waits_for = ""

    def prepare(self, canceled: Callable[[], bool], feedback: Callable[[str], None]) -> None:
        """Reset for a new sequence; both callables are used at every tick."""
        self._canceled, self._feedback = canceled, feedback
        self._watching = self._shielded = False
        self._phase, self.waits_for = "preparing", ""

    def end(self) -> None:
        """Make every wait fail from now on."""
        self._ended.set()

    def ticked_within(self, limit_s: float) -> bool:
        """Return whether the last tick is at most ``limit_s`` old."""
        return time.monotonic() - self._tick_s < limit_s

    def watch(self, enabled: bool) -> None:
        """Switch the check of light and events, which raises ``ScanFailure`` at a tick."""
        if enabled:
            self.monitor.restart_progress()
        self._watching = enabled

    def shield(self) -> None:
        """Raise no ``ScanCanceled`` from here on."""
        self._shielded = True

    @contextlib.contextmanager
    def shielded(self) -> Iterator[None]:
        """Defer a cancel until the block has ended."""
        before, self._shielded = self._shielded, True
        try:
            yield
        finally:
            self._shielded = before

    def drain(self, no_progress_s: float, within_s: float) -> None:
        """Wait until the reconstruction has passed the present time."""
        target_ns, begun_ns = self._now_ns(), self.monitor.until_ns
        begun_s = time.monotonic()
        while self.monitor.until_ns < target_ns:
            self.tick()
            self.monitor.check_reconstruction()
            self.monitor.check_progress(no_progress_s)
            elapsed_s = time.monotonic() - begun_s
            behind_ns = target_ns - self.monitor.until_ns
            advanced_ns = self.monitor.until_ns - begun_ns
            rest_s = elapsed_s * behind_ns / advanced_ns if advanced_ns > 0 else 0.0
            if rest_s > within_s and elapsed_s > min(_PACE_KNOWN_S, within_s):
                raise ScanFailure(
                    f"reconstruction: {behind_ns * 1e-9:.1f} s behind the end of the sweep, "
                    f"{rest_s:.0f} s more at its pace; look at the computer's load and at the "
                    "hosts' clocks, shorten the sweep, or choose a lower frequency"
                )

    def collect(self, duration_s: float) -> None:
        """Wait until the reconstruction has passed this much sensor time from now on."""
        target_ns = self._now_ns() + round(duration_s * 1e9)
        self.monitor.restart_progress()
        while self.monitor.until_ns < target_ns:
            self.tick()

    def report(self, phase: str) -> None:
        """Name the phase in the feedback."""
        self._phase = phase
        # After a signal feedback can no longer be sent.
        with contextlib.suppress(ScanFailure):
            self._feedback(phase)

    def tick(self) -> None:
        """Give feedback, check the reasons to end, sleep for one tick."""
        if self._ended.is_set() or not self._running():
            raise ScanFailure(f"{self._name}: the node was shut down")
        self._feedback(self._phase)
        if self._watching:
            self.check(
                self.monitor.check_laser,
                self.monitor.check_reconstruction,
                lambda: self.monitor.check_progress(self._events_timeout_s),
            )
        self._tick_s = time.monotonic()
        if not self._shielded:
            # One that has failed gives no light until it is configured again.
            self.monitor.check_laser_works()
            if self._canceled():
                raise ScanCanceled
        time.sleep(_TICK_S)

    def check(self, *checks: Callable[[], None]) -> None:
        """Run checks of the other nodes; what fails after a stall of this process names the stall.

        Each raises ``ScanFailure``.
        """
        stall_s = time.monotonic() - self._tick_s
        try:
            for check in checks:
                check()
        except ScanFailure:
            if stall_s > _STALL_S:
                raise ScanFailure(
                    f"{self._name}: its process did not run for {stall_s:.1f} s; look at the "
                    "computer's load"
                ) from None
            raise

    def wait(
        self, condition: Callable[[], bool], timeout_s: float, failure: str | Callable[[], str]
    ) -> None:
        """Wait for ``condition``; raises ``ScanFailure`` with ``failure`` after ``timeout_s``.

        A failure may have a remedy of its own behind a semicolon.
        """
        begun_s = time.monotonic()
        try:
            while not condition():
                waited_s = time.monotonic() - begun_s
                text = failure if isinstance(failure, str) else failure()
                if waited_s > timeout_s:
                    text, _, remedy = text.partition("; ")
                    remedy = remedy or "check that the node runs"
                    raise ScanFailure(f"{text} within {timeout_s:.3g} s; {remedy}")
                self.waits_for = text if waited_s > _NOTED_S else ""
                self.tick()
        finally:
            self.waits_for = ""
