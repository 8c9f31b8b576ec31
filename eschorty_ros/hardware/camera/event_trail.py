"""Spatio-temporal contrast and trail filters, which share one block of the sensor.

Source: openeb 5.1.1 ``imx636_event_trail_filter_module.cpp``. Their resolution of 1 ms is coarse
for a laser modulated at kHz. Unconfirmed on hardware.
"""

from __future__ import annotations

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.hardware.camera.registers import Registers, await_bits, update

TRAIL_TYPES = ("trail", "stc_cut_trail", "stc_keep_trail")
TRAIL_THRESHOLD_US = (1_000, 100_000)

_PIPELINE, _INITIALISATION, _STC, _TRAIL = 0xD000, 0xD0C4, 0xD004, 0xD008
_TIMESTAMPING, _INVALIDATION = 0xD00C, 0xD0C0
_BYPASS, _ON = 0b101, 0b001
_DONE, _REQUEST = 1 << 2, 1 << 0
_ENABLE = 1
_THRESHOLD = 0xF_FFFE
_KEEP_TRAIL = 1 << 24
_TRIES = 3

# Threshold in ms, or a range of them: prescaler / multiplier / timeout.
_TIMING_TEXT = """
1:12/15/90 2:10/3/90 3:11/5/95 4:9/1/102 5:13/15/90 6:11/3/114 7:11/3/90 8:12/5/109 9:13/9/122
10:13/9/90 11:10/1/102 12:14/15/109 13:13/7/117 14:14/13/127 15:12/3/138 16-17:12/3/90
18:14/11/99 19-20:13/5/109 21-22:14/9/122 23:11/1/209 24-25:11/1/138 26-27:15/15/147
28-29:14/7/158 30-31:15/13/170 32-34:13/3/185 35-36:13/3/90 37:15/11/202 38-40:15/11/99
41-44:14/5/109 45:15/9/248 46-49:15/9/122 50-51:12/1/280 52-55:12/1/138 56-58:16/15/147
59-63:15/7/158 64-68:16/13/171 69-73:14/3/185 74:16/11/409 75-80:16/11/202 81:15/5/451
82-88:15/5/223 89-91:16/9/501 92-98:16/9/248 99-100:13/1/564
"""


def _timing() -> dict[int, tuple[int, int, int]]:
    table = {}
    for entry in _TIMING_TEXT.split():
        span, _, numbers = entry.partition(":")
        first, _, last = span.partition("-")
        prescaler, multiplier, timeout = (int(number) for number in numbers.split("/"))
        for threshold_ms in range(int(first), int(last or first) + 1):
            table[threshold_ms] = prescaler, multiplier, timeout
    return table


TIMING = _timing()


def set_event_trail(registers: Registers, kind: str, threshold_us: int) -> int:
    """Switch a filter of :data:`TRAIL_TYPES` on; returns the threshold in force (us).

    Raises ``ArgumentError`` for an unknown kind, or a threshold outside 1000 to 100000 us. Raises
    ``DeviceError`` when the filter's memory does not become ready.
    """
    if kind not in TRAIL_TYPES:
        raise ArgumentError(
            f"trail_filter_type is {kind!r}; choose one of {', '.join(TRAIL_TYPES)}"
        )
    low, high = TRAIL_THRESHOLD_US
    if not low <= threshold_us <= high:
        raise ArgumentError(f"trail_filter_threshold is {threshold_us} us; choose {low} to {high}")
    # Half rounds up, as in openeb.
    threshold_ms = (threshold_us + 500) // 1000
    threshold = threshold_ms * 1000 << 1
    clear_event_trail(registers)
    update(registers, _INITIALISATION, _DONE, _DONE)
    update(registers, _INITIALISATION, _REQUEST, _REQUEST)
    if kind == "trail":
        update(registers, _STC, _ENABLE, 0)
        update(registers, _TRAIL, _ENABLE | _THRESHOLD, _ENABLE | threshold)
    else:
        keep = _KEEP_TRAIL if kind == "stc_keep_trail" else 0
        update(registers, _STC, _ENABLE | _THRESHOLD | _KEEP_TRAIL, _ENABLE | threshold | keep)
        update(registers, _TRAIL, _ENABLE, 0)
    prescaler, multiplier, timeout = TIMING[threshold_ms]
    update(registers, _TIMESTAMPING, 0x1_01FF, prescaler | multiplier << 5 | 1 << 16)
    update(registers, _INVALIDATION, 0xFFF << 12, timeout << 12)
    await_bits(registers, _INITIALISATION, _DONE, _TRIES, "the trail filter")
    registers.write(_PIPELINE, _ON)
    return threshold_ms * 1000


def clear_event_trail(registers: Registers) -> None:
    """Switch the filters off."""
    registers.write(_PIPELINE, _BYPASS)
