"""A camera that looks at a simulated world and sees laser and stage exactly.

Laser and stage may live in other processes: they tell what they do and up to when that is final.
The world is simulated only as far as both are final (conservative synchronisation), so message
delays change when bytes come out, never which.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

from eschorty_ros.core.errors import DeviceError
from eschorty_ros.core.motion import MotionPlan
from eschorty_ros.hardware.protocols import (
    DeviceIdentity,
    EventChunk,
    LaserOutput,
    LaserReadback,
)
from eschorty_ros.simulation.world import World

SILENCE_NS = 1_000_000_000
"""A laser or stage not heard of for so long counts as dark or at rest."""

_PIECE_US = 4_000
_LEAST_US = 1_000
_POLL_S = 0.002


@dataclass
class _Witness:
    """How far one device's doings are known."""

    confirmed_ns: int
    reported_ns: int | None = None
    silent: bool = False
    silences: int = 0
    late: int = 0
    disordered: int = 0

    def accept(self, confirmed_ns: int) -> bool:
        """Take note of a report; ``False`` when a newer one came before it."""
        if self.reported_ns is not None and confirmed_ns < self.reported_ns:
            self.disordered += 1
            return False
        self.reported_ns = confirmed_ns
        self.confirmed_ns = max(self.confirmed_ns, confirmed_ns)
        return True

    def falls_silent(self, now_ns: int) -> bool:
        """Whether silence has just become too long."""
        if self.silent or now_ns - self.confirmed_ns <= SILENCE_NS:
            return False
        self.silent = True
        self.silences += 1
        return True

    def horizon_ns(self, now_ns: int) -> int:
        return min(now_ns, now_ns - SILENCE_NS if self.silent else self.confirmed_ns)


class FakeCamera:
    """Emulated camera over one :class:`World`; thread-safe.

    ``observe_laser`` and ``observe_stage`` must be told a ``confirmed_ns`` that was read from
    ``clock_ns`` *before* the read-back or plan that goes with it, and every change must be
    reported. When one device stays silent for more than 1 s, sensor time goes on 1 s behind the
    clock with the laser dark or the stage at rest, and ``statistics`` counts it.

    Parameters
    ----------
    world : World
        Simulated inside :meth:`read`; nobody else may advance it.
    clock_ns : callable
        The clock of the read-backs, plans and confirmations.
    """

    def __init__(self, world: World, clock_ns: Callable[[], int]) -> None:
        self.identity = DeviceIdentity("simulated event camera", "SIM-CAMERA")
        self.width = world.columns
        self.height = world.rows
        self._world = world
        self._clock_ns = clock_ns
        self._world_lock = threading.Lock()
        self._news = threading.Condition()
        self._inbox: deque[tuple[LaserReadback | MotionPlan, int]] = deque()
        self._zero_ns = clock_ns()
        self._begun_us = 0
        self._laser = _Witness(self._zero_ns)
        self._stage = _Witness(self._zero_ns)
        self._readback: LaserReadback | None = None
        self._plan: MotionPlan | None = None
        self._running = False
        self._closed = False
        self._bytes = 0

    def open(self) -> None:
        """Nothing to wait for: it is there once it is made."""

    def start(self) -> None:
        """Begin streaming; sensor time runs on from where it stopped, from 0 at first.

        Raises
        ------
        DeviceError
            When closed.
        """
        with self._world_lock:
            self._refuse_closed()
            if self._running:
                return
            now_ns = self._clock_ns()
            self._begun_us = self._world.now_us
            self._zero_ns = now_ns - self._begun_us * 1000
            for witness in (self._laser, self._stage):
                witness.confirmed_ns = now_ns
                witness.silent = False
            if self._readback is not None:
                self._apply_laser(self._readback)
            if self._plan is not None:
                self._apply_stage(self._plan)
            self._running = True

    def stop(self) -> None:
        """End streaming and wake a waiting ``read``; idempotent."""
        with self._news:
            self._running = False
            self._news.notify_all()

    def close(self) -> None:
        """Release; idempotent."""
        with self._news:
            self._running = False
            self._closed = True
            self._news.notify_all()

    def sensor_zero_ns(self) -> int:
        """Clock time at which the sensor's clock read zero; valid until the next ``start``."""
        return self._zero_ns

    def observe_laser(self, readback: LaserReadback, confirmed_ns: int) -> None:
        """Learn that the laser is as in ``readback``, with nothing more up to ``confirmed_ns``."""
        self._report(readback, confirmed_ns)

    def observe_stage(self, plan: MotionPlan, confirmed_ns: int) -> None:
        """Learn that the stage follows ``plan``, with nothing more up to ``confirmed_ns``."""
        self._report(plan, confirmed_ns)

    def read(self, timeout_s: float) -> EventChunk | None:
        """Return the next few milliseconds of EVT3, ``None`` when none come within ``timeout_s``.

        Raises
        ------
        DeviceError
            When closed.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            with self._world_lock:
                self._refuse_closed()
                data = self._piece() if self._running else b""
                if data:
                    self._bytes += len(data)
                    return EventChunk(data, self._clock_ns())
            left_s = deadline - time.monotonic()
            if left_s <= 0.0:
                return None
            with self._news:
                if not self._inbox:
                    self._news.wait(min(_POLL_S, left_s))

    def statistics(self) -> dict[str, float]:
        """Count events, bytes, sensor time, lag behind the clock, silences and late reports."""
        now_us = self._world.now_us
        behind_us = (self._clock_ns() - self._zero_ns) // 1000 - now_us
        return {
            "events": float(self._world.events),
            "bytes": float(self._bytes),
            "sensor_time_s": now_us * 1e-6,
            "behind_s": behind_us * 1e-6 if self._running else 0.0,
            "laser_silences": float(self._laser.silences),
            "stage_silences": float(self._stage.silences),
            "laser_late_changes": float(self._laser.late),
            "stage_late_changes": float(self._stage.late),
            "reports_out_of_order": float(self._laser.disordered + self._stage.disordered),
        }

    def _refuse_closed(self) -> None:
        if self._closed:
            raise DeviceError("the simulated camera is closed; open it again")

    def _report(self, report: LaserReadback | MotionPlan, confirmed_ns: int) -> None:
        with self._news:
            self._inbox.append((report, confirmed_ns))
            self._news.notify_all()

    def _piece(self) -> bytes:
        """Simulate the next piece that is final; ``b""`` when there is none."""
        while True:
            self._take_news()
            now_ns = self._clock_ns()
            self._mind_silence(now_ns)
            horizon_ns = min(self._laser.horizon_ns(now_ns), self._stage.horizon_ns(now_ns))
            horizon_us = (horizon_ns - self._zero_ns) // 1000
            begun_us = self._world.now_us
            if horizon_us - begun_us < _LEAST_US:
                return b""
            data = self._world.advance(min(horizon_us, begun_us + _PIECE_US))
            if data:
                return data

    def _take_news(self) -> None:
        while True:
            with self._news:
                if not self._inbox:
                    return
                report, confirmed_ns = self._inbox.popleft()
            if isinstance(report, MotionPlan):
                self._note_stage(report, confirmed_ns)
            else:
                self._note_laser(report, confirmed_ns)

    def _note_laser(self, readback: LaserReadback, confirmed_ns: int) -> None:
        if not self._laser.accept(confirmed_ns):
            return
        if readback != self._readback:
            self._laser.late += self._apply_laser(readback)
        elif self._laser.silent:
            self._apply_laser(readback)
        self._laser.silent = False
        self._readback = readback

    def _note_stage(self, plan: MotionPlan, confirmed_ns: int) -> None:
        if not self._stage.accept(confirmed_ns):
            return
        if plan != self._plan:
            self._stage.late += self._apply_stage(plan)
        elif self._stage.silent:
            self._apply_stage(plan)
        self._stage.silent = False
        self._plan = plan

    def _mind_silence(self, now_ns: int) -> None:
        if self._laser.falls_silent(now_ns):
            self._world.set_laser(self._from_us(self._laser.confirmed_ns)[0], False)
        if self._stage.falls_silent(now_ns):
            since_ns = self._stage.confirmed_ns
            since_us = self._from_us(since_ns)[0]
            rest = MotionPlan(since_ns, self._world.stage_mm(since_us))
            self._world.set_stage(rest, self._zero_ns, since_us)

    def _apply_laser(self, readback: LaserReadback) -> bool:
        """Hand a laser state to the world; whether it came after its time was simulated."""
        # Configuring leaves the output as it is: the change is then the new waveform's epoch.
        epoch_ns = readback.phase_epoch_ns
        if epoch_ns is None:
            epoch_ns = readback.output_since_ns
        since_ns = max(readback.output_since_ns, epoch_ns)
        on = readback.output is not LaserOutput.OFF
        since_us, late = self._from_us(since_ns)
        edge_us = (epoch_ns - self._zero_ns + 500) // 1000
        self._world.set_laser(since_us, on, replace(readback.modulation, on_edge_us=edge_us))
        return late

    def _apply_stage(self, plan: MotionPlan) -> bool:
        """Hand a plan to the world; whether it came after its time was simulated."""
        since_us, late = self._from_us(plan.start_ns)
        self._world.set_stage(plan, self._zero_ns, since_us)
        return late

    def _from_us(self, t_ns: int) -> tuple[int, bool]:
        """Sensor time of ``t_ns``, not before what is simulated, and whether it lay before."""
        t_us = -((self._zero_ns - t_ns) // 1000)
        now_us = self._world.now_us
        return max(t_us, now_us), t_us < now_us and now_us > self._begun_us
