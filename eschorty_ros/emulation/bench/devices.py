"""The bench in one process: camera, generator and stage models around one simulated world."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

from eschorty_ros.core.optics import load_calibration
from eschorty_ros.emulation.apt.model import AptModel
from eschorty_ros.emulation.awg.model import AwgModel
from eschorty_ros.emulation.bench.physics import Imperfections, Physics
from eschorty_ros.emulation.bus import EmulatedUsbDevice
from eschorty_ros.emulation.evk4 import Evk4Model, SensorSettings
from eschorty_ros.simulation.pixels import LIMITS, Biases, preset
from eschorty_ros.simulation.readout import EventRate
from eschorty_ros.simulation.scenes import named
from eschorty_ros.simulation.world import BACKGROUND_HZ, Effects, SensorControl, World, warm_up


@dataclass(frozen=True, slots=True)
class BenchSettings:
    """Scene, optical build, pixels and wiring of the bench."""

    scene: str = "steps"
    """A scene's name or a mesh file."""
    calibration: str = "config_3"
    """The actual optical build, a name or a file."""
    pixels: str = "paper"
    """Preset of the event pixels."""
    seed: int = 1
    background_hz: float = BACKGROUND_HZ
    """Background events of one pixel."""
    trigger: str = "stage"
    """Output that is wired to the camera's trigger input: ``none``, ``laser`` or ``stage``."""
    imperfections: Imperfections = field(default_factory=Imperfections)
    laser_log: str = ""
    """File with one line per change of the generator's output; empty for none."""
    effects: str = "none"
    """Effects of the world, as ``Effects.parse`` reads them."""


class Bench:
    """Models of camera, generator and stage that act on each other as real ones do.

    - ``clock_ns``: The bench's clock.

    Raises ``EschortyError`` for a scene or calibration that cannot be used.
    """

    def __init__(
        self, settings: BenchSettings, clock_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        calibration = load_calibration(settings.calibration)
        self._model = calibration.model()
        self._scene = named(settings.scene, self._model)
        pixels = preset(settings.pixels)
        effects = Effects.parse(settings.effects)
        warm_up(calibration)

        def world() -> World:
            return World(
                self._scene,
                calibration,
                pixels,
                settings.seed,
                settings.background_hz,
                effects=effects,
            )

        self.physics = Physics(
            world,
            clock_ns,
            settings.imperfections,
            settings.trigger,
            lambda from_ns, until_ns: self.stage.trigger_pulses(from_ns, until_ns),
        )
        self.stage = AptModel(clock_ns, on_plan=self.physics.set_stage)
        self.laser = AwgModel(clock_ns, log_path=settings.laser_log or None)
        self.laser.on_change = self.physics.set_laser
        # No command may run while the world advances to the present.
        self.laser.mutex = self.physics.lock
        self.camera = Evk4Model(self.physics)
        self.camera.lateness_ns = lambda: self.physics.late_ns
        self.camera.configure = self._configure

    def _configure(self, settings: SensorSettings) -> None:
        self.physics.packet_us = settings.packet_period_us
        self.physics.set_sensor(sensor_control(settings))

    def set_scene(self, scene: str) -> None:
        """Set the scene from the next start of the stream on."""
        self._scene = named(scene, self._model)

    def usb_devices(self) -> list[EmulatedUsbDevice]:
        """Return the devices on the USB bus."""
        return [self.camera, self.laser]


def sensor_control(settings: SensorSettings) -> SensorControl:
    """Return the simulation's biases and event rate; biases are clipped to their normal range."""
    offsets = dict(settings.biases)
    biases = {
        name: min(max(offsets[f"bias_{name}"], low), high) for name, (low, high) in LIMITS.items()
    }
    rate = settings.event_rate
    return SensorControl(Biases(**biases), EventRate(*rate) if rate else None)
