"""Why an order cannot be carried out, each with its remedy."""

from __future__ import annotations

from eschorty_ros.core.errors import DeviceError, DeviceGoneError
from eschorty_ros.hardware.stage import apt_messages as apt
from eschorty_ros.hardware.stage.apt_judge import Status
from eschorty_ros.hardware.stage.apt_tracker import Tracker


def ready(tracker: Tracker, closed: bool) -> Status:
    """Newest status of a stage that takes orders; raises ``DeviceError`` when it takes none."""
    if tracker.failure is not None:
        raise tracker.failure
    if closed:
        raise DeviceGoneError("the stage is closed; open it again")
    if tracker.motion is not None:
        raise DeviceError("the stage is moving; stop it or wait before the next move")
    assert tracker.status is not None
    if not tracker.status.bits & apt.ENABLED:
        raise DeviceError("the stage is not enabled; check the front panel, configure again")
    return tracker.status


def may_move(
    status: Status, blocked_sense: int, position_mm: float, travel_mm: tuple[float, float]
) -> None:
    """Raise ``DeviceError`` when ``position_mm`` cannot be reached.

    ``blocked_sense`` is the sign of the way that a limit has barred, 0 when none has.
    """
    if not status.bits & apt.HOMED:
        raise DeviceError("the stage is not homed; home it before moving")
    low, high = travel_mm
    if not low <= position_mm <= high:
        raise DeviceError(f"position_mm is {position_mm!r}; the travel is {low:g} to {high:g} mm")
    if blocked_sense * (position_mm - status.position_mm) > 0.0:
        raise DeviceError(
            f"the stage met a limit at {status.position_mm:.3f} mm; move it back from there "
            "first, and check the travel for obstacles"
        )


def may_run_at(speed_mm_s: float, speed_max_mm_s: float) -> None:
    """Raise ``DeviceError`` when the stage has no such speed."""
    if not 0.0 < speed_mm_s <= speed_max_mm_s:
        raise DeviceError(
            f"speed_mm_s is {speed_mm_s!r}; choose above 0 to {speed_max_mm_s:g} mm/s"
        )
