"""The drivers that the ``driver`` parameter names, and their parameters.

A driver is imported when it is chosen. ``fake`` is the real driver at an emulated bench.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from eschorty_ros.core.base.errors import ArgumentError, DeviceGoneError
from eschorty_ros.emulation.bench.folder import READY_FILE, bench_folder, stage_port, usb_spec
from eschorty_ros.hardware.base.protocols import EventSource, LaserModulator, LinearStage
from eschorty_ros.hardware.laser.awg_settings import AwgSettings
from eschorty_ros.hardware.stage.apt_setup import CONTROLLERS, AptSettings
from eschorty_ros.nodes.ros.conversions import mm_from_m
from eschorty_ros.nodes.ros.parameters import Param, from_settings

ClockNs = Callable[[], int]
Device = TypeVar("Device")
Registry = dict[str, Callable[[Mapping[str, Any], ClockNs], Device]]

DRIVER = (
    Param("driver", "fake", "camera: evk4; laser: awg; stage: apt; "
          "fake: the real driver at an emulated bench"),
    Param("bench", "", "folder of that bench; empty: the user's in this ROS domain"),
)  # fmt: skip
STAGE_TABLE = (
    Param("port", "", "serial port or pyserial URL of the stage controller; empty finds it"),
    Param("serial", "", "USB serial number of the stage controller; empty takes the only one"),
    Param("controller", "kbd101", "stage controller", choices=CONTROLLERS),
    Param("bay", 1, "bay of the rack, from 1", "", 1, 10),
    Param("speed_max", 0.25, "cap on the speed the controller reports", "m/s", 0.001, 1.0),
    Param("acceleration", 2.0, "cap on the acceleration it reports", "m/s^2", 0.01, 20.0),
    Param("travel_low", 0.0, "lower end of the travel to use", "m", -1.0, 1.0),
    Param("travel_high", 0.22, "upper end of the travel to use", "m", -1.0, 1.0),
    Param("homing_speed", 0.025, "speed of homing", "m/s", 0.001, 0.1),
    Param("poll_rate", 50.0, "rate of status requests", "Hz", 5.0, 200.0),
    Param("trigger_interval", 0.002, "distance of pulses for the camera; 0 = none", "m", 0.0, 0.1),
    Param("trigger_port", 1, "output of the controller that gives the pulses", "", 1, 3),
)
REAL = {"camera": "evk4", "laser": "awg", "stage": "apt"}

LASER_TABLE = from_settings(AwgSettings)


def _bench(parameters: Mapping[str, Any]) -> Path:
    """Return the folder of the bench; raises ``DeviceGoneError`` when no bench runs there."""
    folder = bench_folder(parameters["bench"])
    if not (folder / READY_FILE).exists():
        raise DeviceGoneError(f"no emulated bench in {folder}; start eschorty-bench")
    return folder


def _fake_camera(parameters: Mapping[str, Any], clock_ns: ClockNs) -> EventSource:
    return _evk4({**parameters, "backend": usb_spec(_bench(parameters))}, clock_ns)


def _evk4(parameters: Mapping[str, Any], clock_ns: ClockNs) -> EventSource:
    from eschorty_ros.hardware.base.usb import open_backend
    from eschorty_ros.hardware.camera.evk4 import Evk4
    from eschorty_ros.hardware.camera.reconnection import Reconnection
    from eschorty_ros.nodes.camera.parameters import camera_settings

    return Evk4(
        open_backend(parameters["backend"]),
        clock_ns,
        parameters["serial"],
        camera_settings(parameters),
        Reconnection(parameters["reconnect_attempts"]),
    )


def _fake_laser(parameters: Mapping[str, Any], clock_ns: ClockNs) -> LaserModulator:
    return _awg({**parameters, "backend": usb_spec(_bench(parameters))}, clock_ns)


def _awg(parameters: Mapping[str, Any], clock_ns: ClockNs) -> LaserModulator:
    from eschorty_ros.hardware.laser_guard.guarded import GuardedLaser

    settings = {param.name: parameters[param.name] for param in LASER_TABLE}
    # Refused here, before a process is started for it.
    AwgSettings(**settings)
    return GuardedLaser("eschorty_ros.hardware.laser.awg:open_laser", settings)


def _apt(parameters: Mapping[str, Any], clock_ns: ClockNs) -> LinearStage:
    from eschorty_ros.hardware.stage.apt_stage import open_stage

    settings = AptSettings(
        controller=parameters["controller"],
        bay=parameters["bay"],
        speed_max_mm_s=mm_from_m(parameters["speed_max"]),
        acceleration_mm_s2=mm_from_m(parameters["acceleration"]),
        travel_mm=(mm_from_m(parameters["travel_low"]), mm_from_m(parameters["travel_high"])),
        homing_mm_s=mm_from_m(parameters["homing_speed"]),
        poll_hz=parameters["poll_rate"],
        trigger_interval_mm=mm_from_m(parameters["trigger_interval"]),
        trigger_port=parameters["trigger_port"],
    )
    return open_stage(settings, clock_ns, parameters["port"], parameters["serial"])


def _fake_stage(parameters: Mapping[str, Any], clock_ns: ClockNs) -> LinearStage:
    return _apt({**parameters, "port": stage_port(_bench(parameters))}, clock_ns)


CAMERAS: Registry[EventSource] = {"fake": _fake_camera, "evk4": _evk4}
LASERS: Registry[LaserModulator] = {"fake": _fake_laser, "awg": _awg}
STAGES: Registry[LinearStage] = {"fake": _fake_stage, "apt": _apt}


def make(registry: Registry[Device], parameters: Mapping[str, Any], clock_ns: ClockNs) -> Device:
    """Return the device that the ``driver`` parameter names.

    Raises
    ------
    ArgumentError
        For an unknown name.
    EschortyError
        When the driver refuses its parameters.
    """
    name = parameters["driver"]
    if name not in registry:
        raise ArgumentError(f"driver {name!r} is unknown; choose one of {', '.join(registry)}")
    return registry[name](parameters, clock_ns)
