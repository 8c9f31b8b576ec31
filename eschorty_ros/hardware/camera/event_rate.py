"""Event-rate control: the sensor drops events beyond a rate.

Source: openeb 5.1.1 ``gen41_erc.cpp``. Dropped events bias a centroid: leave the control off for
accuracy. Whether its tables survive a reset is unconfirmed on hardware, so they are always written.
"""

from __future__ import annotations

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.hardware.camera.registers import Registers, Write, run_sequence, update

PERIOD_US = 200
COUNT_MAX = 640_000
ERC_RATE_MAX = COUNT_MAX * 1_000_000 // PERIOD_US

_CONTROL, _TARGET, _SWITCH, _COUNT = 0x6000, 0x602C, 0x6050, 0x600C
_COUNT_MASK = 0x3F_FFFF

_BEFORE_TABLES = (
    Write(_CONTROL, 0, 0x3),
    Write(0x6004, 1, 0x1),
    Write(0x6008, PERIOD_US, 0x3FF),
    Write(_COUNT, 20_000_000 * PERIOD_US // 1_000_000, _COUNT_MASK),
    Write(0x6028, 0x3, 0x7),
    Write(_TARGET, 1, 0x1),
)
_TABLES = (
    *(Write(0x6800 + 4 * i, 0x0808_0808) for i in range(230)),
    Write(_TARGET, 0, 0x1),
    *(Write(0x6400 + 4 * i, (2 * i + 1) << 16 | 2 * i) for i in range(256)),
)
_AFTER_TABLES = (
    Write(_SWITCH, 0),
    Write(0x6060, 0),
    Write(0x6070, 0),
    Write(_CONTROL, 1, 0x3),
)
INITIALISE = _BEFORE_TABLES + _TABLES + _AFTER_TABLES


def initialise(registers: Registers) -> None:
    """Write the tables and switch the control off, after the sensor's initialisation."""
    run_sequence(registers, INITIALISE, lambda _s: None)


def set_event_rate(registers: Registers, rate: int | None) -> int:
    """Set the limit (events/s), ``None`` to switch the control off; return it as read back, or 0.

    Raises ``ArgumentError`` for a rate outside 5000 to 3.2e9 events/s.
    """
    if rate is None:
        update(registers, _SWITCH, 1, 0)
        return 0
    count = rate * PERIOD_US // 1_000_000
    if not 1 <= count <= COUNT_MAX:
        raise ArgumentError(
            f"erc_rate is {rate} events/s; choose {1_000_000 // PERIOD_US} to {ERC_RATE_MAX}"
        )
    update(registers, _SWITCH, 1, 1)
    update(registers, _COUNT, _COUNT_MASK, count)
    return (registers.read(_COUNT) & _COUNT_MASK) * 1_000_000 // PERIOD_US
