"""Thorlabs DDS stage behind a KBD101 or a BBD30x: moves that end by themselves, faults with names.

Unconfirmed on hardware: the sense of the direction bits (never used), the homing end, the delay
between an order and its motion (fitted), and the length of the racks' trigger message.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable

from eschorty_ros.core.base.errors import DeviceError, DeviceGoneError, DeviceTimeoutError
from eschorty_ros.core.clocks import plan_move
from eschorty_ros.hardware.base.protocols import StageState
from eschorty_ros.hardware.stage import apt_messages as apt
from eschorty_ros.hardware.stage.apt_link import AptLink
from eschorty_ros.hardware.stage.apt_port import find_port, open_port
from eschorty_ros.hardware.stage.apt_setup import AptSettings, AptSetup
from eschorty_ros.hardware.stage.apt_status import Status
from eschorty_ros.hardware.stage.apt_tracker import BYTE_NS, Kind, Tracker

_MOVE_NS = 12 * BYTE_NS
# A controller sends 50 status messages without one.
_KEEP_ALIVE_S, _KEEP_ALIVE_STATUSES = 0.5, 20
_HEALTH_S = 0.05
_ENABLE_S = 10.0
_FIRST_STATUS_S = 1.5
_CLOSE_S = 1.2
# Two clocks are read together; a thread that is suspended between them reads again.
_READ_NS = 100_000
_READS_MAX = 10
# At rest a reading comes twice in the least lag, so that a state is between two of them.
_REST_POLL_S = 0.05
_PROFILED, _IMMEDIATE = 2, 1
_ON, _OFF = 1, 2

MakeLink = Callable[[Callable[[apt.Frame, int], None], Callable[[DeviceError], None]], AptLink]


def open_stage(
    settings: AptSettings, clock_ns: Callable[[], int], port: str, serial: str
) -> AptStage:
    """Return the stage on ``port``, or on the port whose USB serial number is ``serial``.

    Raises ``DeviceError`` when there is no such port or no such stage behind it.
    """
    opened = open_port(port or find_port(settings.controller, serial))

    def make_link(
        on_frame: Callable[[apt.Frame, int], None], on_lost: Callable[[DeviceError], None]
    ) -> AptLink:
        link = AptLink(opened, on_frame, on_lost)
        link.start()
        return link

    return AptStage(make_link, clock_ns, settings)


class AptStage:
    """Linear stage over APT; its positions are those of ``lag_s`` ago, between two readings.

    - ``make_link``: Makes a link from its callbacks for a frame and for a lost port.
    - ``clock_ns``: Clock of ``state().t_ns``.

    Raises ``DeviceError`` when the controller does not answer, refuses a setting, or does not
    enable the axis.
    """

    def __init__(
        self, make_link: MakeLink, clock_ns: Callable[[], int], settings: AptSettings
    ) -> None:
        self.lag_s = max(0.1, 3.5 / settings.poll_hz + 0.02)
        self._clock_ns = clock_ns
        self._settings = settings
        self._lock = threading.RLock()
        self._stopping: list[tuple[int, bytes]] = []
        self._closed = False
        # Both counters show a stop and an order that cross, on either side.
        self._stops = self._orders = 0
        self._unacknowledged = 0
        # Frames that come at once wait for the tracker.
        with self._lock:
            self._link = make_link(self._on_frame, self._on_lost)
            self._tracker = Tracker(self, self._link.now_ns, clock_ns)
        self._setup = AptSetup(self._link, settings)
        try:
            self._connect()
        except BaseException:
            self._link.close()
            raise

    def _connect(self) -> None:
        # First: a controller that a program has left without it for long answers nothing before.
        self._link.call_every(lambda: _KEEP_ALIVE_S, self._keep_alive)
        self._setup.send("connect")
        self._setup.send("stop_updates")
        # The program that used it before may have left it moving.
        self._setup.send("stop", mode=_PROFILED)
        axis = self._setup.read_axis()
        self._axis = axis
        self._tracker.scale = axis.scale
        self.identity = axis.identity
        self.travel_mm = axis.travel_mm
        self.speed_max_mm_s = axis.speed_max_mm_s
        self.acceleration_mm_s2 = axis.acceleration_mm_s2
        self._setup.write(axis)
        self.trigger = self._setup.write_trigger(axis)
        self._setup.send("set_enabled", state=_ON)
        self._tracker.begin_motion(Kind.STOP, 0.0, 0.0, self.speed_max_mm_s, _ENABLE_S)
        self._link.call_every(self._poll_s, self.request_status)
        self._link.call_every(lambda: _HEALTH_S, self._check_health)
        if not self._link.wait_until(lambda: self._tracker.status is not None, _FIRST_STATUS_S):
            raise DeviceTimeoutError(
                f"stage: {self.identity.model} sends no status; check that no other program uses it"
            )
        self._link.wait_until(
            lambda: (
                self._tracker.failure is not None
                or (self._tracker.motion is None and self._tracker.enabled)
            ),
            _ENABLE_S,
        )
        if self._tracker.failure is not None:
            raise self._tracker.failure
        if not self._tracker.enabled:
            raise DeviceError(
                "stage: the controller does not enable the axis; check its front panel, the "
                "interlock and the motor cable"
            )

    def home(self) -> None:
        """Start homing; raises ``DeviceError`` when moving, failed or closed."""
        with self._lock:
            self._ready()
            low, high = self.travel_mm
            speed = min(self._settings.homing_mm_s, self.speed_max_mm_s)
            limit_s = (high - low) / speed + 10.0
            self._orders += 1
            self._tracker.begin_motion(Kind.HOME, high, low, speed, limit_s)
            self._tracker.fit.expect_unknown(self._clock_ns())
            self._tracker.blocked_sense = 0
            self._send_now("home")

    def move_to(self, position_mm: float, speed_mm_s: float) -> None:
        """Start a move; raises ``DeviceError`` when it is refused or stopped before it begins."""
        with self._lock:
            stops = self._stops
            status = self._ready()
            self._check_move(status, position_mm, speed_mm_s)
        speed, acceleration = self._setup.write_velocity(self._axis, speed_mm_s)
        if self.trigger is not None:
            self._setup.arm_trigger(self._axis, self.trigger, status.position_mm, position_mm)
        with self._lock:
            if stops != self._stops:
                raise DeviceError("stage refused: it was stopped before the move began")
            start = self._ready().position_mm
            counts = self._tracker.scale.position(position_mm)
            target = self._tracker.scale.mm(counts)
            if counts == self._tracker.scale.position(start):
                return
            limit_s = abs(target - start) / speed + 2.0 * speed / acceleration + 2.0
            self._orders += 1
            self._tracker.begin_motion(Kind.MOVE, start, target, speed, limit_s)
            order_ns = self._clock_ns()
            self._send_now("move_absolute", position=counts)
            self._tracker.fit.expect_move(
                plan_move(order_ns + _MOVE_NS, start, target, speed, acceleration)
            )

    def stop(self) -> None:
        """Begin a profiled stop; idempotent, and on the wire at once."""
        orders = self._orders
        self._stops += 1
        self._send_stop()
        with self._lock:
            if orders != self._orders:
                # An order may have gone out after it.
                self._send_stop()
            self._tracker.begin_stop(self.acceleration_mm_s2)

    def state(self, t_ns: int | None = None) -> StageState:
        """Return position, velocity and flags at ``t_ns``, by default the newest time known.

        Raises ``DeviceError`` when the stage has failed, with the reason.
        """
        with self._lock:
            if self._tracker.failure is not None:
                raise self._tracker.failure
            return self._tracker.state(t_ns, round(self.lag_s * 1e9))

    @property
    def healthy(self) -> bool:
        """Return whether status messages come and nothing has failed."""
        return self._tracker.failure is None and not self._closed and not self._tracker.late

    def statistics(self) -> dict[str, float]:
        """Return counters for diagnostics."""
        framer, fit = self._link.framer, self._tracker.fit
        return {
            "fit_residual_um": fit.residual_mm * 1e3,
            "fit_sigma_um": fit.sigma_mm * 1e3,
            "fit_outliers": fit.outliers,
            "status_age_s": self._tracker.age_ns * 1e-9,
            "statuses_rejected": self._tracker.checks.rejected,
            "late_statuses": fit.late_readings,
            "command_errors": self._tracker.command_errors,
            "clock_sets": self._tracker.clock_sets,
            "frames": framer.frames,
            "skipped_bytes": framer.skipped_bytes,
            "broken_frames": framer.broken_frames,
        }

    def close(self) -> None:
        """Stop, wait for rest, release the port; idempotent, bounded in time."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            failed = self._tracker.failure is not None
            moving = self._tracker.motion is not None
        with contextlib.suppress(DeviceError):
            if moving or failed:
                self._send_now("stop", mode=_PROFILED)
                if not self._link.wait_until(lambda: self._tracker.motion is None, _CLOSE_S):
                    self._send_now("stop", mode=_IMMEDIATE)
                if failed:
                    self._send_now("set_enabled", state=_OFF)
            self._send_now("disconnect")
        self._link.close()

    # Orders

    def _ready(self) -> Status:
        """Return the newest status; raise ``DeviceError`` when no order can be carried out."""
        tracker = self._tracker
        if tracker.failure is not None:
            raise tracker.failure
        if self._closed:
            raise DeviceGoneError("the stage is closed; open it again")
        if tracker.motion is not None:
            raise DeviceError("the stage is moving; stop it or wait before the next move")
        assert tracker.status is not None
        if not tracker.enabled:
            raise DeviceError("the stage is not enabled; check the front panel, configure again")
        return tracker.status

    def _check_move(self, status: Status, position_mm: float, speed_mm_s: float) -> None:
        if not status.bits & apt.HOMED:
            raise DeviceError("the stage is not homed; home it before moving")
        low, high = self.travel_mm
        if not low <= position_mm <= high:
            raise DeviceError(
                f"position_mm is {position_mm!r}; the travel is {low:g} to {high:g} mm"
            )
        if self._tracker.blocked_sense * (position_mm - status.position_mm) > 0.0:
            raise DeviceError(
                f"the stage met a limit at {status.position_mm:.3f} mm; move it back from there "
                "first, and check the travel for obstacles"
            )
        if not 0.0 < speed_mm_s <= self.speed_max_mm_s:
            raise DeviceError(
                f"speed_mm_s is {speed_mm_s!r}; choose above 0 to {self.speed_max_mm_s:g} mm/s"
            )

    def _send_now(self, name: str, **values: int) -> None:
        self._link.send_now(apt.pack(name, self._settings.address, **values))

    def _send_stop(self) -> None:
        with contextlib.suppress(DeviceError):
            self._send_now("stop", mode=_PROFILED)

    # Timers, in the writer's thread

    def _keep_alive(self) -> None:
        self._unacknowledged = 0
        self._link.write(apt.pack("keep_alive", self._settings.address))

    def _poll_s(self) -> float:
        period_s = 1.0 / self._settings.poll_hz
        return period_s if self._tracker.motion is not None else max(period_s, _REST_POLL_S)

    def request_status(self) -> None:
        """Request a status unless one is on its way; see ``Actions``."""
        if self._tracker.begin_poll():
            self._link.write(apt.pack("request_status", self._settings.address))

    def _check_health(self) -> None:
        # The writer must not block: it also sends the keep-alive of the controller's watchdog.
        if not self._lock.acquire(timeout=_HEALTH_S):
            return
        try:
            now_ns = self._link.now_ns()
            due = [frame for at_ns, frame in self._stopping if at_ns <= now_ns]
            self._stopping = [entry for entry in self._stopping if entry[0] > now_ns]
            self._tracker.check_age()
        finally:
            self._lock.release()
        for frame in due:
            self._link.write(frame)

    # Frames, in the reader's thread

    def _on_frame(self, frame: apt.Frame, received_ns: int) -> None:
        clock_ns = received_ns + self._clock_offset_ns()
        if frame.source != self._settings.address and not frame.name.startswith("error"):
            return
        with self._lock:
            self._unacknowledged += frame.name in ("status", "moved", "stopped")
            if self._unacknowledged >= _KEEP_ALIVE_STATUSES:
                self._keep_alive()
            match frame.name:
                case "status":
                    self._tracker.add_status(frame, received_ns, clock_ns)
                case "moved" | "stopped" | "homed":
                    if self._tracker.motion is not None:
                        self._tracker.motion.ended_by_message = True
                case "error":
                    self.fail(
                        DeviceError("the stage controller reports an error; look at its display")
                    )
                case "error_text":
                    code, text = frame.integer("code"), frame.text("text")
                    self.fail(
                        DeviceError(
                            f"the stage controller reports error {code}: {text or 'no text'}; "
                            "clear its cause, then configure again"
                        )
                    )

    def _clock_offset_ns(self) -> int:
        """Return the lead of the stamping clock over the link's, read while nothing intervenes."""
        for _ in range(_READS_MAX):
            before_ns = self._link.now_ns()
            clock_ns = self._clock_ns()
            after_ns = self._link.now_ns()
            if after_ns - before_ns < _READ_NS:
                break
        return clock_ns - (before_ns + after_ns) // 2

    # Failure

    def _on_lost(self, error: DeviceError) -> None:
        with self._lock:
            self.fail(error)

    def fail(self, error: DeviceError, escalate: bool = False) -> None:
        """Stop for good; with ``escalate`` stop at once and switch the current off soon after."""
        if self._tracker.failure is not None:
            return
        self._tracker.failure = error
        self._send_stop()
        if escalate:
            address, now_ns = self._settings.address, self._link.now_ns()
            stop = apt.pack("stop", address, mode=_IMMEDIATE)
            disable = apt.pack("set_enabled", address, state=_OFF)
            self._stopping = [(now_ns + 200_000_000, stop), (now_ns + 300_000_000, disable)]
