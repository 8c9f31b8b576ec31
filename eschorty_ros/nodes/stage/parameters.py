"""Parameters of the stage's driver."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from eschorty_ros.control.scan_sequence import MoveLimits
from eschorty_ros.hardware.base.protocols import LinearStage
from eschorty_ros.hardware.stage.apt_setup import CONTROLLERS, AptSettings
from eschorty_ros.hardware.stage.apt_stage import open_stage
from eschorty_ros.nodes.ros.conversions import mm_from_m
from eschorty_ros.nodes.ros.drivers import ClockNs
from eschorty_ros.nodes.ros.parameters import Param

DRIVER_TABLE = (
    Param(
        "port",
        "",
        "serial port or pyserial URL of the controller; empty: found by its serial",
    ),
    Param("serial", "", "USB serial number of the stage controller; empty: the only one"),
    Param("controller", "kbd101", "stage controller", choices=CONTROLLERS),
    Param("bay", 1, "bay of the rack, from 1", "", 1, 10),
    Param("speed_max", 0.25, "cap on the speed the controller reports", "m/s", 0.001, 1.0),
    Param("acceleration", 2.0, "cap on the acceleration it reports", "m/s^2", 0.01, 20.0),
    Param("travel_low", 0.0, "lower end of the travel to use", "m", -1.0, 1.0),
    Param("travel_high", 0.22, "upper end of the travel to use", "m", -1.0, 1.0),
    Param("homing_speed", 0.025, "speed of homing", "m/s", 0.001, 0.1),
    Param("poll_rate", 50.0, "rate of status requests; 20 Hz at most at rest", "Hz", 5.0, 200.0),
    Param("trigger_interval", 0.002, "distance of pulses for the camera; 0 = none", "m", 0.0, 0.1),
    Param("trigger_port", 1, "output of the controller for the pulses", "", 1, 3),
)


def stage_limits(parameters: Mapping[str, Any]) -> MoveLimits:
    """Return the caps on what the controller reports."""
    return MoveLimits(
        travel_mm=(mm_from_m(parameters["travel_low"]), mm_from_m(parameters["travel_high"])),
        speed_max_mm_s=mm_from_m(parameters["speed_max"]),
        acceleration_mm_s2=mm_from_m(parameters["acceleration"]),
    )


def make_stage(parameters: Mapping[str, Any], clock_ns: ClockNs) -> LinearStage:
    """Open the stage with the node's parameters."""
    caps = stage_limits(parameters)
    settings = AptSettings(
        controller=parameters["controller"],
        bay=parameters["bay"],
        speed_max_mm_s=caps.speed_max_mm_s,
        acceleration_mm_s2=caps.acceleration_mm_s2,
        travel_mm=caps.travel_mm,
        homing_mm_s=mm_from_m(parameters["homing_speed"]),
        poll_hz=parameters["poll_rate"],
        trigger_interval_mm=mm_from_m(parameters["trigger_interval"]),
        trigger_port=parameters["trigger_port"],
    )
    return open_stage(settings, clock_ns, parameters["port"], parameters["serial"])
