"""A laser in memory whose commands can be held up."""

from __future__ import annotations

import threading

from waiting import DEADLINE_S

from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.hardware.base.protocols import DeviceIdentity, LaserOutput, LaserReadback


class HeldLaser:
    """In memory; a command named in ``hold`` waits for ``go`` before it is carried out;
    ``switched_off`` tells of a ``disable`` meanwhile."""

    def __init__(self) -> None:
        self.identity = DeviceIdentity("held", "1")
        self.hold = ""
        self.reached, self.go = threading.Event(), threading.Event()
        self.switched_off = threading.Event()
        self.lit = self.armed = False
        self.modulation = Modulation(70.0)
        self.lightings = self.offs = 0

    def _wait(self, command: str) -> None:
        if self.hold == command:
            self.reached.set()
            assert self.go.wait(DEADLINE_S)

    def configure(self, modulation: Modulation) -> None:
        self._wait("configure")
        self.modulation = modulation

    def arm(self) -> None:
        self._wait("arm")
        self.armed = True

    def enable(self) -> None:
        self._wait("enable")
        if not self.armed:
            raise DeviceError("not armed")
        self.armed, self.lit = False, True
        self.lightings += 1

    def disable(self) -> None:
        self.armed = self.lit = False
        self.offs += 1
        if self.hold:
            self.switched_off.set()

    def readback(self) -> LaserReadback:
        self._wait("readback")
        output = LaserOutput.ON if self.lit else LaserOutput.OFF
        return LaserReadback(output, self.modulation, None, 0)

    def close(self) -> None:
        self.disable()
