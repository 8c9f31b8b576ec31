"""Sensor time, host time and stage position, each as a function of the others."""

from eschorty_ros.core.clocks.clock_line import NS_PER_US, ClockLine
from eschorty_ros.core.clocks.edge_clock import EdgeClock
from eschorty_ros.core.clocks.edge_fit import fit_edges
from eschorty_ros.core.clocks.lower_envelope import LowerEnvelope
from eschorty_ros.core.clocks.motion import MotionPlan, plan_move, plan_stop
from eschorty_ros.core.clocks.motion_fit import MotionFit
from eschorty_ros.core.clocks.pulses import PulseTrain, leading_edges
from eschorty_ros.core.clocks.sensor_clock import SensorClock
from eschorty_ros.core.clocks.stage_track import (
    NM_PER_MM,
    POSITION_LIMIT_MM,
    SPEED_LIMIT_MM_S,
    StageTrack,
    quantise_nm,
)

__all__ = [
    "NM_PER_MM",
    "NS_PER_US",
    "POSITION_LIMIT_MM",
    "SPEED_LIMIT_MM_S",
    "ClockLine",
    "EdgeClock",
    "LowerEnvelope",
    "MotionFit",
    "MotionPlan",
    "PulseTrain",
    "SensorClock",
    "StageTrack",
    "fit_edges",
    "leading_edges",
    "plan_move",
    "plan_stop",
    "quantise_nm",
]
