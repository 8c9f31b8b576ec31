"""Regions of interest and hot pixels, masked in the sensor.

Source: openeb 5.1.1 ``gen41_roi_command.cpp``, ``gen41_digital_event_mask.cpp``. Columns and rows
are masked separately, so several windows become the product of their columns and their rows. That
mask row = EVT3 row is unconfirmed on hardware.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.hardware.camera.imx636 import HEIGHT, WIDTH
from eschorty_ros.hardware.camera.registers import Registers, update

Window = tuple[int, int, int, int]
"""First column, first row, width, height (px)."""

HOT_PIXELS_MAX = 64

_COLUMNS, _ROWS, _HOT = 0x2000, 0x4000, 0x9100
_CONTROL, _WINDOW_GO = 0x0004, 0x0034
_ENABLE, _SHADOW, _INSIDE, _PIXELS_ON = 1 << 1, 1 << 5, 1 << 6, 1 << 10
_VALID = 1 << 31


def windows_of(flat: Sequence[int]) -> tuple[Window, ...]:
    """Return the windows of a flat list x, y, width, height, x, ...

    Raises ``ArgumentError`` when a window is incomplete, empty or outside the sensor.
    """
    if len(flat) % 4:
        raise ArgumentError(f"roi has {len(flat)} numbers; give x, y, width, height per window")
    windows = [(flat[i], flat[i + 1], flat[i + 2], flat[i + 3]) for i in range(0, len(flat), 4)]
    for x, y, width, height in windows:
        inside = 0 <= x < x + width <= WIDTH and 0 <= y < y + height <= HEIGHT
        if not inside:
            raise ArgumentError(
                f"roi window {x}, {y}, {width}, {height} leaves the sensor; "
                f"it has {WIDTH} columns and {HEIGHT} rows"
            )
    return tuple(windows)


def set_windows(registers: Registers, windows: Sequence[Window]) -> None:
    """Keep the pixels whose column and row are inside a window; all of them without windows."""
    for first, kept in zip((_COLUMNS, _ROWS), _lines(windows), strict=True):
        for index, word in enumerate(_mask_words(kept)):
            registers.write(first + 4 * index, word)
    mask = _ENABLE | _SHADOW | _INSIDE | _PIXELS_ON
    update(registers, _CONTROL, mask, mask if windows else mask & ~_ENABLE)
    registers.write(_WINDOW_GO, 0)


def set_hot_pixels(registers: Registers, pixels: Sequence[tuple[int, int]]) -> None:
    """Mask up to 64 pixels given as (column, row).

    Raises ``ArgumentError`` for too many, or one outside the sensor.
    """
    if len(pixels) > HOT_PIXELS_MAX:
        raise ArgumentError(
            f"hot_pixels names {len(pixels)} pixels, the sensor masks {HOT_PIXELS_MAX}; "
            "keep the worst ones"
        )
    for x, y in pixels:
        if not (0 <= x < WIDTH and 0 <= y < HEIGHT):
            raise ArgumentError(
                f"hot_pixels has {x},{y}; the sensor has {WIDTH} columns and {HEIGHT} rows"
            )
    words = [_VALID | y << 16 | x for x, y in pixels]
    for index in range(HOT_PIXELS_MAX):
        registers.write(_HOT + 4 * index, words[index] if index < len(words) else 0)


def _lines(windows: Sequence[Window]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    columns = np.full(WIDTH, not windows)
    rows = np.full(HEIGHT, not windows)
    for x, y, width, height in windows:
        columns[x : x + width] = True
        rows[y : y + height] = True
    return columns, rows


def _mask_words(kept: NDArray[np.bool_]) -> list[int]:
    """Return the words of a mask in which 1 switches a line off; lines past the last are off."""
    padded = np.ones(-(-kept.size // 32) * 32, dtype=bool)
    padded[: kept.size] = ~kept
    if kept.all():
        padded[:] = False
    packed = np.packbits(padded, bitorder="little")
    return [int(word) for word in packed.view("<u4")]
