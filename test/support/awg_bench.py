"""A generator model and the driver on it, in one process, without waiting."""

from pathlib import Path
from typing import Any

from output_log import read_output_log

from eschorty_ros.core.modulation import Modulation
from eschorty_ros.emulation.awg.model import AwgModel
from eschorty_ros.emulation.bus import EmulatedBackend
from eschorty_ros.hardware.laser.awg import AwgLaser
from eschorty_ros.hardware.laser.awg_settings import AwgSettings

SQUARE = Modulation(70.0, 0.5, "square")


class Clock:
    def __init__(self) -> None:
        self.now_ns = 10**18

    def __call__(self) -> int:
        return self.now_ns


class AwgBench:
    """A bus with one generator on it, and lasers opened on that bus; the last one made counts."""

    def __init__(self, log_path: Path | None = None) -> None:
        self._log_path = log_path
        self.clock = Clock()
        self.model = AwgModel(self.clock, log_path, wait=lambda *_: False, steady_ns=self.clock)
        self.models = [self.model]
        _buses[:] = [self]

    def outputs(self) -> list[str]:
        """ON and OFF as the generator logged them."""
        return [output for _, output in read_output_log(self._log_path)]

    def settings(self, **changes: Any) -> AwgSettings:
        return AwgSettings(**{"backend": f"{__name__}:on_the_bus", **changes})

    def laser(self, **changes: Any) -> AwgLaser:
        return AwgLaser(self.settings(**changes), self.clock)

    def ready_laser(self, **changes: Any) -> AwgLaser:
        laser = self.laser(**changes)
        laser.configure(SQUARE)
        laser.arm()
        return laser

    def lit_laser(self, **changes: Any) -> AwgLaser:
        laser = self.ready_laser(**changes)
        laser.enable()
        assert self.model.lit
        return laser


_buses: list[AwgBench] = []


def on_the_bus() -> EmulatedBackend:
    """Backend of the last bench: what ``backend`` of its settings names."""
    return EmulatedBackend(lambda: _buses[-1].models)
