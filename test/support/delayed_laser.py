"""A laser in memory whose commands can be delayed."""

import threading

from waiting import DEADLINE_S

from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.hardware.base.protocols import DeviceIdentity, LaserOutput, LaserReadback


class DelayedLaser:
    """The command named in ``delayed`` waits for ``go``; a ``disable`` then sets ``disabled``."""

    def __init__(self) -> None:
        self.identity = DeviceIdentity("delayed", "1")
        self.delayed = ""
        self.reached, self.go = threading.Event(), threading.Event()
        self.disabled = threading.Event()
        self.lit = self.armed = False
        self.modulation = Modulation(70.0)
        self.enablings = self.offs = 0

    def _wait(self, command: str) -> None:
        if self.delayed == command:
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
        self.enablings += 1

    def disable(self) -> None:
        self.armed = self.lit = False
        self.offs += 1
        if self.delayed:
            self.disabled.set()

    def readback(self) -> LaserReadback:
        self._wait("readback")
        output = LaserOutput.ON if self.lit else LaserOutput.OFF
        return LaserReadback(output, self.modulation, 0)

    def close(self) -> None:
        self.disable()
