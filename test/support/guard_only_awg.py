"""The generator's driver, imported only in the guard: its owner is small and ends quickly."""

from typing import Any

from eschorty_ros.hardware.base.protocols import RenewedLaser


def open_laser(**settings: Any) -> RenewedLaser:
    from eschorty_ros.hardware.laser import awg

    return awg.open_laser(**settings)
