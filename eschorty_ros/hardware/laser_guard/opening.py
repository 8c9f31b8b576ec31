"""Opening a generator by the name of its driver, and the same one again after a loss."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Any

from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.hardware.base.protocols import RenewedLaser


def maker(name: str, settings: Mapping[str, Any]) -> Callable[[], RenewedLaser]:
    """Return the function that opens the generator: ``module:callable`` with keywords.

    Raises ``DeviceError`` when there is no such callable.
    """
    module, _, attribute = name.partition(":")
    try:
        make = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise DeviceError(
            f"laser driver {name!r} cannot be loaded ({error}); install it"
        ) from error
    return lambda: make(**settings)


def open_again(make: Callable[[], RenewedLaser], serial: str) -> RenewedLaser:
    """Open the generator that was lost, which disables its output.

    Raises ``DeviceError`` when it is not there; the output of another one proves nothing.
    """
    laser = make()
    found = laser.identity.serial
    if serial and found and found != serial:
        laser.close()
        raise DeviceError(f"generator {serial} is gone, {found} is there; connect {serial}")
    return laser
