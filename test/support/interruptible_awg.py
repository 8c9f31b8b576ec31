"""The generator's driver with a read-back that ends only by ``disable``, or ends the process."""

import os
import time
from pathlib import Path
from typing import Any

from eschorty_ros.hardware.base.protocols import LaserReadback
from eschorty_ros.hardware.laser.awg import AwgLaser
from eschorty_ros.hardware.laser.awg_settings import AwgSettings


class InterruptibleAwg(AwgLaser):
    """With ``waits`` reading back makes that file and waits; without it the process exits."""

    def __init__(self, waits: str, settings: AwgSettings) -> None:
        super().__init__(settings)
        self._waits = waits

    def readback(self) -> LaserReadback:
        if not self._waits:
            os._exit(7)
        with self._command():
            Path(self._waits).touch()
            while True:
                self._refuse_void()
                time.sleep(0.002)


def open_laser(waits: str = "", **settings: Any) -> InterruptibleAwg:
    return InterruptibleAwg(waits, AwgSettings(**settings))
