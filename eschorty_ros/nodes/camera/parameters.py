"""Parameters of the camera node, with the names of ``metavision_driver`` where it has them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.hardware.base.protocols import EventSource
from eschorty_ros.hardware.base.usb import open_backend
from eschorty_ros.hardware.camera import (
    ANTI_FLICKER_HZ,
    BIASES,
    ERC_RATE_MAX,
    HEIGHT,
    PACKET_PERIOD_US,
    TRAIL_THRESHOLD_US,
    TRAIL_TYPES,
    WIDTH,
    AntiFlicker,
    CameraSettings,
    Evk4,
    Window,
    load_bias_file,
    windows_of,
)
from eschorty_ros.nodes.ros.drivers import ClockNs
from eschorty_ros.nodes.ros.parameters import Param

_IGNORED = "; the emulated camera ignores it"
_LEAVE = -1
_FULL_FRAME = (0, 0, WIDTH, HEIGHT)

_BIAS_TABLE = tuple(
    Param(
        name,
        0,
        f"offset from the factory trim, acts on the {info.acts_on}; "
        f"normal range {info.normal[0]} to {info.normal[1]}"
        + (_IGNORED if name == "bias_hpf" else ""),
        "",
        *info.wide,
        dynamic=True,
    )
    for name, info in BIASES.items()
)

EVK4_TABLE = (
    Param("serial", "", "serial number of the camera (hex); empty: the only one"),
    Param("backend", "libusb", "USB backend: libusb, or module:callable[?argument]"),
    Param("reconnect_attempts", 6, "searches for a lost camera before the node fails", "", 0, 1000),
    Param("bias_file", "", "file of biases, read at start where a bias_* is 0; save_biases writes"),
    Param(
        "bias_range",
        "normal",
        "ranges of the biases: wide ones may make the sensor noisy or insensitive",
        choices=("normal", "wide"),
    ),
    *_BIAS_TABLE,
    Param(
        "mipi_frame_period",
        _LEAVE,
        "period of the sensor's packets (latency), in steps of 16; -1 leaves 4000",
        "us",
        _LEAVE,
        PACKET_PERIOD_US[1],
    ),
    Param(
        "erc_mode",
        "na",
        "event-rate control, off unless enabled: dropped events are counted and bias the centroid",
        choices=("na", "disabled", "enabled"),
    ),
    Param("erc_rate", 100_000_000, "rate beyond which it drops", "events/s", 5_000, ERC_RATE_MAX),
    Param(
        "roi",
        _FULL_FRAME,
        "x, y, width, height per window; windows act as the product of their columns and rows",
        "px",
        dynamic=True,
    ),
    Param("hot_pixels", "", "pixels to mask, at most 64: 'x,y x,y'"),
    Param(
        "trail_filter",
        False,
        "filter of trailing events: those left of a moving line are ahead of it" + _IGNORED,
    ),
    Param("trail_filter_type", "trail", "kind of that filter", choices=TRAIL_TYPES),
    Param(
        "trail_filter_threshold",
        10_000,
        "threshold of that filter, in steps of 1 ms",
        "us",
        *TRAIL_THRESHOLD_US,
    ),
    Param(
        "trigger_in_mode",
        "disabled",
        "trigger input; an EVK4 has no trigger output",
        choices=("disabled", "external"),
    ),
    Param("anti_flicker", False, "filter of flicker: erases a laser in its band" + _IGNORED),
    Param("anti_flicker_low", 50, "lower edge of its band", "Hz", *ANTI_FLICKER_HZ),
    Param("anti_flicker_high", 520, "upper edge of its band", "Hz", *ANTI_FLICKER_HZ),
    Param("anti_flicker_band_pass", False, "keep what flickers in the band instead"),
)


def camera_settings(parameters: Mapping[str, Any]) -> CameraSettings:
    """Return the settings of an EVK4 from the node's parameters.

    Raises ``ArgumentError`` for a value outside its range. Raises ``FormatError`` for a malformed
    bias file.
    """
    enabled, period_us = parameters["erc_mode"] == "enabled", parameters["mipi_frame_period"]
    return CameraSettings(
        biases=_biases(parameters),
        wide_biases=parameters["bias_range"] == "wide",
        packet_period_us=None if period_us == _LEAVE else period_us,
        erc_rate=parameters["erc_rate"] if enabled else None,
        anti_flicker=_anti_flicker(parameters),
        trail_filter=parameters["trail_filter_type"] if parameters["trail_filter"] else "",
        trail_threshold_us=parameters["trail_filter_threshold"],
        windows=windows_given(parameters),
        hot_pixels=_pixels(parameters["hot_pixels"]),
        trigger_input=parameters["trigger_in_mode"] == "external",
    )


def windows_given(parameters: Mapping[str, Any]) -> tuple[Window, ...]:
    """Return the regions of interest, none for the full frame.

    Raises ``ArgumentError`` when one is outside the sensor.
    """
    roi = tuple(parameters["roi"])
    return () if roi == _FULL_FRAME else windows_of(roi)


def _anti_flicker(parameters: Mapping[str, Any]) -> AntiFlicker | None:
    """Return the band of the anti-flicker filter, ``None`` when it is off."""
    if not parameters["anti_flicker"]:
        return None
    return AntiFlicker(
        parameters["anti_flicker_low"],
        parameters["anti_flicker_high"],
        parameters["anti_flicker_band_pass"],
    )


def missing_bias_file(parameters: Mapping[str, Any]) -> str:
    """Return one line when the bias file does not exist yet, else an empty string."""
    path = parameters["bias_file"]
    if not path or Path(path).exists():
        return ""
    return f"bias_file {path!r} does not exist yet; save_biases makes it"


def _biases(parameters: Mapping[str, Any]) -> dict[str, int]:
    given = {name: parameters[name] for name in BIASES if parameters[name]}
    path = parameters["bias_file"]
    kept = load_bias_file(path) if path and not missing_bias_file(parameters) else {}
    return {**kept, **given}


def _pixels(text: str) -> tuple[tuple[int, int], ...]:
    pixels = []
    for pair in text.split():
        x, _, y = pair.partition(",")
        if not (x.isdecimal() and y.isdecimal()):
            raise ArgumentError(f"hot_pixels holds {pair!r}; write 'x,y x,y'")
        pixels.append((int(x), int(y)))
    return tuple(pixels)


def make_camera(parameters: Mapping[str, Any], clock_ns: ClockNs) -> EventSource:
    """Return the camera's driver with the node's parameters."""
    return Evk4(
        open_backend(parameters["backend"]),
        clock_ns,
        parameters["serial"],
        camera_settings(parameters),
        parameters["reconnect_attempts"],
    )
