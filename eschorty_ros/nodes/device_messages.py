"""Messages of laser and stage as the device protocols' values."""

from __future__ import annotations

from eschorty_ros.core.motion import MotionPlan
from eschorty_ros.hardware.protocols import LaserOutput, LaserReadback, PulseTrain
from eschorty_ros.msg import LaserState, PositionTrigger, StageMotion
from eschorty_ros.nodes.conversions import (
    m_from_mm,
    mm_from_m,
    modulation_from_laser_state,
    ns_from_stamp,
    stamp_from_ns,
)


def readback_from_state(message: LaserState) -> LaserReadback:
    """Take what the generator said from ``laser/state``."""
    modulation, epoch_ns = modulation_from_laser_state(message)
    return LaserReadback(
        LaserOutput(message.output),
        modulation,
        epoch_ns,
        ns_from_stamp(message.output_since),
    )


def motion_message(plan: MotionPlan, stamp_ns: int) -> StageMotion:
    """``stage/motion`` of a plan that holds until ``stamp_ns`` at least."""
    message = StageMotion(
        start=stamp_from_ns(plan.start_ns),
        position=m_from_mm(plan.position_mm),
        velocity=m_from_mm(plan.velocity_mm_s),
        durations=list(plan.durations_s),
        accelerations=[m_from_mm(a) for a in plan.accelerations_mm_s2],
    )
    message.header.stamp = stamp_from_ns(stamp_ns)
    return message


def plan_from_motion(message: StageMotion) -> MotionPlan:
    """Plan of ``stage/motion``: what the stage holds, to float64 rounding of the unit."""
    return MotionPlan(
        ns_from_stamp(message.start),
        mm_from_m(message.position),
        mm_from_m(message.velocity),
        tuple(message.durations),
        tuple(mm_from_m(a) for a in message.accelerations),
    )


def trigger_message(train: PulseTrain | None, stamp_ns: int) -> PositionTrigger:
    """``stage/trigger`` of the pulses the stage gives from ``stamp_ns`` on."""
    message = PositionTrigger()
    if train is not None:
        message.first = m_from_mm(train.first_mm)
        message.interval = m_from_mm(train.interval_mm)
        message.count = train.count
    message.header.stamp = stamp_from_ns(stamp_ns)
    return message
