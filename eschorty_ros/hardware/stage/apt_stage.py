"""Thorlabs DDS stage behind a KBD101 or a BBD30x: moves that end by themselves, faults with names.

Unconfirmed on hardware: the sense of the direction bits (never used), the homing end, the delay
between an order and its motion (fitted), and the racks' trigger messages.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable

from eschorty_ros.core.errors import DeviceError, DeviceGoneError, DeviceTimeoutError
from eschorty_ros.core.motion import plan_move
from eschorty_ros.core.motion_fit import MotionFit
from eschorty_ros.hardware.protocols import StageState
from eschorty_ros.hardware.stage import apt_messages as apt
from eschorty_ros.hardware.stage.apt_follow import BEGIN_NS, TOLERANCE_MM, Kind, Motion, Outcome
from eschorty_ros.hardware.stage.apt_judge import LATE_NS, Judge, Status, Verdict
from eschorty_ros.hardware.stage.apt_link import AptLink
from eschorty_ros.hardware.stage.apt_port import find_port, open_port
from eschorty_ros.hardware.stage.apt_setup import AptSettings, AptSetup

BYTE_NS = 86_806
REQUEST_NS = 6 * BYTE_NS
ANSWER_NS = 20 * BYTE_NS
MOVE_NS = 12 * BYTE_NS
KEEP_ALIVE_S = 0.5
HEALTH_S = 0.05
WARN_AGE_NS = 500_000_000
FAULT_AGE_NS = 1_500_000_000
_POLL_LOST_NS = 250_000_000
_ENABLE_S = 10.0
_FIRST_STATUS_S = 1.5
_CLOSE_S = 1.2
_PROFILED, _IMMEDIATE = 2, 1
_ON, _OFF = 1, 2

MakeLink = Callable[[Callable[[apt.Frame, int], None], Callable[[DeviceError], None]], AptLink]


class AptStage:
    """Linear stage over APT; positions lie ``lag_s`` in the past, where readings surround them.

    Parameters
    ----------
    make_link : callable
        Makes a link, given what to call for frames and for a lost port.
    clock_ns : callable
        Clock of ``state().t_ns``.
    settings : AptSettings

    Raises
    ------
    DeviceError
        When the controller does not answer, refuses a setting, or does not enable the axis.
    """

    def __init__(
        self, make_link: MakeLink, clock_ns: Callable[[], int], settings: AptSettings
    ) -> None:
        self.lag_s = max(0.1, 3.5 / settings.poll_hz + 0.02)
        self._clock_ns = clock_ns
        self._settings = settings
        self._lock = threading.RLock()
        self._fit = MotionFit(TOLERANCE_MM)
        self._judge = Judge()
        self._scale = apt.Scale()
        self._failure: DeviceError | None = None
        self._motion: Motion | None = None
        self._status: Status | None = None
        self._status_ns: int | None = None
        self._poll: tuple[int, int] | None = None
        self._unmatched_until_ns = 0
        self._rest_ns = 0
        self._blocked_sense = 0
        self._stopping: list[tuple[int, bytes]] = []
        self._closed = False
        self._link = make_link(self._on_frame, self._on_lost)
        self._setup = AptSetup(self._link, settings)
        try:
            self._connect()
        except BaseException:
            self._link.close()
            raise

    def _connect(self) -> None:
        self._setup.tell("stop_updates")
        # Whoever used it before may have left it moving.
        self._setup.tell("stop", channel=apt.CHANNEL, mode=_PROFILED)
        axis = self._setup.read_axis()
        self._axis = axis
        self._scale = axis.scale
        self.identity = axis.identity
        self.travel_mm = axis.travel_mm
        self.speed_max_mm_s = axis.speed_max_mm_s
        self.acceleration_mm_s2 = axis.acceleration_mm_s2
        self._setup.write(axis)
        self.trigger = self._setup.write_trigger(axis)
        self._setup.tell("set_enabled", channel=apt.CHANNEL, state=_ON)
        self._motion = self._ordered(Kind.STOP, 0.0, 0.0, self.speed_max_mm_s, _ENABLE_S)
        self._link.every(KEEP_ALIVE_S, self._keep_alive)
        self._link.every(1.0 / self._settings.poll_hz, self._ask_status)
        self._link.every(HEALTH_S, self._check_health)
        if not self._link.wait_until(lambda: self._status is not None, _FIRST_STATUS_S):
            raise DeviceTimeoutError(
                f"stage: {self.identity.model} sends no status; check that no other program uses it"
            )
        self._link.wait_until(
            lambda: self._failure is not None or (self._motion is None and self._has(apt.ENABLED)),
            _ENABLE_S,
        )
        if self._failure is not None:
            raise self._failure
        if not self._has(apt.ENABLED):
            raise DeviceError(
                "stage: the controller does not enable the axis; check its front panel, the "
                "interlock and the motor cable"
            )

    # LinearStage

    def home(self) -> None:
        """Start homing; raises ``DeviceError`` when moving, failed or closed."""
        with self._lock:
            self._ready()
            low, high = self.travel_mm
            speed = min(self._settings.homing_mm_s, self.speed_max_mm_s)
            limit_s = (high - low) / speed + 10.0
            self._motion = self._ordered(Kind.HOME, high, low, speed, limit_s)
            self._fit.wander(self._clock_ns())
            self._blocked_sense = 0
            self._send_now("home", channel=apt.CHANNEL)

    def move_to(self, position_mm: float, speed_mm_s: float) -> None:
        """Start a move; raises ``DeviceError`` when it cannot be carried out."""
        with self._lock:
            status = self._ready()
            self._check_move(position_mm, speed_mm_s, status)
        speed, acceleration = self._setup.write_velocity(self._axis, speed_mm_s)
        with self._lock:
            status = self._ready()
            counts = self._scale.position(position_mm)
            target = self._scale.mm(counts)
            start = status.position_mm
            distance = abs(target - start)
            if counts == self._scale.position(start):
                return
            limit_s = distance / speed + 2.0 * speed / acceleration + 2.0
            self._motion = self._ordered(Kind.MOVE, start, target, speed, limit_s)
            order_ns = self._clock_ns()
            self._send_now("move_absolute", channel=apt.CHANNEL, position=counts)
            self._fit.follow(plan_move(order_ns + MOVE_NS, start, target, speed, acceleration))

    def stop(self) -> None:
        """Profiled stop; idempotent, and on the wire at once."""
        with contextlib.suppress(DeviceError):
            self._send_now("stop", channel=apt.CHANNEL, mode=_PROFILED)
        with self._lock:
            motion = self._motion
            if motion is None:
                return
            if motion.kind is Kind.MOVE:
                self._fit.stop(self._clock_ns() + REQUEST_NS, self.acceleration_mm_s2)
            motion.stop()

    def state(self, t_ns: int | None = None) -> StageState:
        """Position, velocity and flags at ``t_ns``, by default the newest time that is known.

        Raises
        ------
        DeviceError
            When the stage has failed, with the reason.
        """
        with self._lock:
            if self._failure is not None:
                raise self._failure
            until_ns = self._fit.until_ns
            status = self._status
            assert until_ns is not None
            assert status is not None
            newest_ns = min(self._clock_ns() - round(self.lag_s * 1e9), until_ns)
            t_ns = newest_ns if t_ns is None else min(t_ns, until_ns)
            position, velocity = (float(value) for value in self._fit.state(t_ns))
            flags = apt.decode_bits(status.bits)
            if self._age_ns() > WARN_AGE_NS:
                flags = (*flags, "status_late")
            moving = self._motion is not None or t_ns < self._rest_ns
            homed = bool(status.bits & apt.HOMED) and not self._homing()
            return StageState(position, velocity, t_ns, homed, moving, flags)

    def plan(self) -> None:
        """Tell nothing: only the controller knows when a motion began."""
        return

    @property
    def healthy(self) -> bool:
        """Whether status messages come and nothing has failed."""
        return self._failure is None and not self._closed and self._age_ns() < WARN_AGE_NS

    def statistics(self) -> dict[str, float]:
        """Counters for diagnostics."""
        framer, fit = self._link.framer, self._fit
        return {
            "fit_residual_um": fit.residual_mm * 1e3,
            "fit_sigma_um": fit.sigma_mm * 1e3,
            "fit_strays": fit.strays,
            "status_age_s": self._age_ns() * 1e-9,
            "statuses_rejected": self._judge.rejected,
            "late_statuses": fit.late_readings,
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
            failed = self._failure is not None
            moving = self._motion is not None
        with contextlib.suppress(DeviceError):
            if moving or failed:
                self._send_now("stop", channel=apt.CHANNEL, mode=_PROFILED)
                if not self._link.wait_until(lambda: self._motion is None, _CLOSE_S):
                    self._send_now("stop", channel=apt.CHANNEL, mode=_IMMEDIATE)
                if failed:
                    self._send_now("set_enabled", channel=apt.CHANNEL, state=_OFF)
            self._send_now("disconnect")
        self._link.close()

    # Orders

    def _ready(self) -> Status:
        if self._failure is not None:
            raise self._failure
        if self._closed:
            raise DeviceGoneError("the stage is closed; open it again")
        if self._motion is not None:
            raise DeviceError("the stage is moving; stop it or wait before the next move")
        assert self._status is not None
        if not self._status.bits & apt.ENABLED:
            raise DeviceError("the stage is not enabled; check the front panel, configure again")
        return self._status

    def _check_move(self, position_mm: float, speed_mm_s: float, status: Status) -> None:
        if not status.bits & apt.HOMED:
            raise DeviceError("the stage is not homed; home it before moving")
        low, high = self.travel_mm
        if not low <= position_mm <= high:
            raise DeviceError(
                f"position_mm is {position_mm!r}; the travel is {low:g} to {high:g} mm"
            )
        if not 0.0 < speed_mm_s <= self.speed_max_mm_s:
            raise DeviceError(
                f"speed_mm_s is {speed_mm_s!r}; choose above 0 to {self.speed_max_mm_s:g} mm/s"
            )
        if self._blocked_sense * (position_mm - status.position_mm) > 0.0:
            raise DeviceError(
                f"the stage met a limit at {status.position_mm:.3f} mm; move it back from there "
                "first, and check the travel for obstacles"
            )

    def _send_now(self, name: str, **values: int) -> None:
        self._link.send_now(apt.pack(name, self._settings.address, **values))

    # Timers, in the writer's thread

    def _keep_alive(self) -> None:
        self._link.write_at_once(apt.pack("keep_alive", self._settings.address))

    def _ask_status(self) -> None:
        now_ns = self._link.now_ns()
        # One at a time: so an answer belongs to its request.
        if self._poll is not None:
            if now_ns - self._poll[1] < _POLL_LOST_NS:
                return
            # Its answer may still come, and must not be taken for the next one's.
            self._unmatched_until_ns = now_ns + LATE_NS
        self._poll = self._clock_ns(), now_ns
        self._link.write_at_once(
            apt.pack("request_status", self._settings.address, channel=apt.CHANNEL)
        )

    def _check_health(self) -> None:
        with self._lock:
            now_ns = self._link.now_ns()
            due = [frame for at_ns, frame in self._stopping if at_ns <= now_ns]
            self._stopping = [entry for entry in self._stopping if entry[0] > now_ns]
            motion = self._motion
            if self._status is not None and self._age_ns() > FAULT_AGE_NS:
                self._fail(
                    DeviceGoneError(
                        f"the stage controller is silent for {FAULT_AGE_NS * 1e-9:g} s; check its "
                        "power and cable"
                    )
                )
            elif motion is not None and now_ns > motion.deadline_ns:
                self._fail(
                    DeviceError(
                        f"the stage's {motion.kind.value} does not end in time; check the travel "
                        "for obstacles, then configure again"
                    )
                )
        for frame in due:
            self._link.write_at_once(frame)

    # Frames, in the reader's thread

    def _on_frame(self, frame: apt.Frame, received_ns: int) -> None:
        clock_ns = self._clock_ns()
        if frame.source != self._settings.address:
            return
        with self._lock:
            match frame.name:
                case "status":
                    self._on_status(frame, received_ns, clock_ns)
                case "moved" | "stopped" | "homed":
                    if self._motion is not None:
                        self._motion.ended_by_message = True
                case "error":
                    self._fail(
                        DeviceError("the stage controller reports an error; look at its display")
                    )
                case "error_text":
                    code, text = frame.whole("code"), frame.text("text")
                    self._fail(
                        DeviceError(
                            f"the stage controller reports error {code}: {text or 'no text'}; "
                            "clear its cause, then configure again"
                        )
                    )

    def _on_status(self, frame: apt.Frame, received_ns: int, clock_ns: int) -> None:
        latest_ns = clock_ns - ANSWER_NS
        earliest_ns = None
        if self._poll is not None and received_ns >= self._unmatched_until_ns:
            earliest_ns = min(self._poll[0] + REQUEST_NS, latest_ns)
        self._poll = None
        position_mm = self._scale.mm(frame.whole("position"))
        status = Status(position_mm, frame.whole("bits"), earliest_ns, latest_ns)
        self._status_ns = received_ns
        motion = self._motion
        expected = None
        if motion is None and self._status is not None:
            expected = (self._status.position_mm, self._status.position_mm)
        elif motion is not None and motion.kind is not Kind.HOME:
            expected = self._fit.expected_mm(
                latest_ns - LATE_NS if earliest_ns is None else earliest_ns, latest_ns
            )
        speed = 0.0 if motion is None else motion.speed_mm_s
        if self._status is None or self._failure is not None:
            self._judge.forget()
        match self._judge.judge(status, expected, speed):
            case Verdict.ASK_AGAIN:
                self._ask_status()
            case Verdict.CONTRADICTORY:
                self._fail(
                    DeviceError(
                        "two status messages of the stage running make no sense; check the cable "
                        "for interference"
                    )
                )
            case verdict:
                self._believe(status, verdict)

    def _believe(self, status: Status, verdict: Verdict) -> None:
        before, self._status = self._status, status
        if self._failure is not None:
            if before is not None and before.position_mm == status.position_mm:
                self._motion = None
            return
        if before is not None and not self._homing():
            lost = before.bits & ~status.bits
            if lost & (apt.HOMED | apt.ENABLED):
                what = "its reference" if lost & apt.HOMED else "the axis enabled"
                self._fail(
                    DeviceError(
                        f"the stage controller does not have {what} any more, as after a restart; "
                        "configure and home again"
                    )
                )
                return
            if verdict is Verdict.JUMPED:
                jump_mm = status.position_mm - before.position_mm
                self._fail(
                    DeviceError(
                        f"the stage's encoder jumped by {jump_mm:.3f} mm; home again and check the "
                        "encoder's cable"
                    )
                )
                return
        if status.bits & apt.FAULTS:
            names = ", ".join(apt.decode_bits(status.bits & apt.FAULTS))
            self._fail(DeviceError(f"the stage controller reports {names}; clear its cause"))
            return
        if not (self._homing() and status.bits & apt.HOMED):
            self._fit.observe(status.position_mm, status.latest_ns, status.earliest_ns)
        if self._motion is not None:
            self._follow(self._motion, before, status, verdict)

    def _follow(
        self, motion: Motion, before: Status | None, status: Status, verdict: Verdict
    ) -> None:
        what, at_mm = motion.kind.value, status.position_mm
        match motion.follow(before, status, verdict, self._link.now_ns()):
            case Outcome.MET_LIMIT:
                self._blocked_sense = motion.sense
                self.stop()
            case Outcome.ENDED:
                self._end(motion, status)
            case Outcome.NOT_BEGUN:
                self._fail(
                    DeviceError(
                        f"the stage does not begin its {what} within {BEGIN_NS * 1e-9:g} s; check "
                        "its front panel, the interlock and the motor cable"
                    )
                )
            case Outcome.STUCK:
                self._fail(
                    DeviceError(
                        f"the stage is stuck at {at_mm:.3f} mm on its {what} to "
                        f"{motion.target_mm:.3f} mm; check the travel for obstacles, then "
                        "configure again"
                    ),
                    escalate=True,
                )

    def _end(self, motion: Motion, status: Status) -> None:
        self._motion = None
        self._rest_ns = status.latest_ns
        if status.bits & apt.HOMED and motion.kind is Kind.HOME:
            # Before, the encoder counted from somewhere else.
            self._fit = MotionFit(TOLERANCE_MM)
            self._fit.observe(status.position_mm, status.latest_ns, status.earliest_ns)
            return
        planned_mm = float(self._fit.state(status.latest_ns)[0])
        if abs(planned_mm - status.position_mm) > TOLERANCE_MM:
            self._fit.doubt()
        if self._blocked_sense and motion.sense == -self._blocked_sense:
            self._blocked_sense = 0

    def _ordered(
        self, kind: Kind, start_mm: float, target_mm: float, speed: float, limit_s: float
    ) -> Motion:
        now_ns = self._link.now_ns()
        return Motion(kind, start_mm, target_mm, speed, now_ns, now_ns + round(limit_s * 1e9))

    # Failure

    def _on_lost(self, error: DeviceError) -> None:
        with self._lock:
            self._failure = self._failure or error

    def _fail(self, error: DeviceError, escalate: bool = False) -> None:
        """Stop at once; a stuck carriage also loses its current."""
        if self._failure is not None:
            return
        self._failure = error
        with contextlib.suppress(DeviceError):
            self._send_now("stop", channel=apt.CHANNEL, mode=_PROFILED)
        if escalate:
            address, now_ns = self._settings.address, self._link.now_ns()
            self._stopping = [
                (
                    now_ns + 200_000_000,
                    apt.pack("stop", address, channel=apt.CHANNEL, mode=_IMMEDIATE),
                ),
                (
                    now_ns + 300_000_000,
                    apt.pack("set_enabled", address, channel=apt.CHANNEL, state=_OFF),
                ),
            ]

    def _has(self, bits: int) -> bool:
        return self._status is not None and bool(self._status.bits & bits)

    def _homing(self) -> bool:
        return self._motion is not None and self._motion.kind is Kind.HOME

    def _age_ns(self) -> int:
        return 0 if self._status_ns is None else self._link.now_ns() - self._status_ns


def open_stage(
    settings: AptSettings, clock_ns: Callable[[], int], port: str = "", serial: str = ""
) -> AptStage:
    """Open the stage on ``port``, or on the port whose USB serial number is ``serial``.

    Raises
    ------
    DeviceError
        With the remedy when there is no such port or no such stage behind it.
    """
    opened = open_port(port or find_port(settings.controller, serial))

    def make_link(
        on_frame: Callable[[apt.Frame, int], None], on_lost: Callable[[DeviceError], None]
    ) -> AptLink:
        link = AptLink(opened, on_frame, on_lost)
        link.start()
        return link

    return AptStage(make_link, clock_ns, settings)
