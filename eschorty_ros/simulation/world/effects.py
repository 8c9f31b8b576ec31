"""What light and readout do to a recording, each off unless a scene needs it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Annotated

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.numbers import short
from eschorty_ros.core.base.schema import Schema, Within, validate
from eschorty_ros.core.base.yaml_file import parse_yaml
from eschorty_ros.core.optics import RangeModel
from eschorty_ros.simulation.pixels import PixelParameters
from eschorty_ros.simulation.readout import ReadoutParameters
from eschorty_ros.simulation.scenes import Scene
from eschorty_ros.simulation.world.falloff import Falloff
from eschorty_ros.simulation.world.occlusion import Visible

_Beside = Annotated[float, Within(-1000.0, 1000.0)]


@dataclass(frozen=True, kw_only=True)
class Effects(Schema):
    """Effects of the simulated world; the defaults leave all of them out.

    Raises ``ArgumentError`` for a value outside its range.
    """

    ambient: Annotated[float, Within(0.0, 1000.0)] = 0.0
    """Ambient light on the pixels, as a multiple of the line's peak on a white surface. Contrast
    falls; shot noise keeps its size in log intensity, but the bandwidth grows with the light and
    with it the number of background events."""
    falloff_mm: Annotated[float, Within(above=0.0, high=1e6)] | None = None
    """The line is as bright as without this effect at this range, and falls with the square."""
    defocus_mm: _Beside = 0.0
    """Distance of the plane in focus from the laser sheet."""
    ghost: Annotated[float, Within(0.0, 1.0)] = 0.0
    ghost_mm: _Beside = 0.0
    """A second sheet by reflection, so much of the first one's light and so far beside it in the
    direction of the stage: about 3.8 rows per mm at 1.3 m, and out of focus."""
    occlusion: Annotated[int, Within(0, 1)] = 0
    """1 hides from the camera what is behind other parts of the scene."""
    row_time_us: Annotated[float, Within(1e-3, 1e6)] = ReadoutParameters().row_time_us
    """Time the readout spends on one row: :class:`ReadoutParameters`."""

    def _conflicts(self) -> Iterator[tuple[str, str]]:
        if self.ghost and not self.ghost_mm:
            yield "ghost_mm", "give the ghost a distance"

    @staticmethod
    def parse(text: str) -> Effects:
        """Return the effects of a text such as ``ambient=0.5,occlusion=1``, or ``none``.

        Raises ``ArgumentError`` for an unknown effect or a value outside its range.
        """
        yaml = "{}" if text == "none" else "{" + text.replace("=", ": ") + "}"
        try:
            document = parse_yaml(yaml.encode(), "effects", ArgumentError)
            if None in document.data.values():
                raise ArgumentError("a name has no value")
        except ArgumentError:
            raise ArgumentError(
                f"effects is {short(text)}; write NAME=VALUE,... with each name once, or none"
            ) from None
        names = [field.name for field in fields(Effects)]
        for name in document.data:
            if name not in names:
                raise ArgumentError(
                    f"effects: there is none named {short(name)}; choose of {', '.join(names)}"
                )
        return validate(Effects, replace(document, lines={}), ArgumentError)

    def pixels(self, parameters: PixelParameters, model: RangeModel) -> PixelParameters:
        """Return the pixels under the ambient light, and with the line of the nearest range."""
        brightest = 1.0
        if self.falloff_mm is not None:
            brightest = (self.falloff_mm / model.range_limits_mm[0]) ** 2
        ambient = self.ambient * parameters.amplitude
        return replace(
            parameters,
            background_intensity=parameters.background_intensity + ambient,
            amplitude=parameters.amplitude * brightest,
        )

    def scene(self, scene: Scene, model: RangeModel) -> Scene:
        """Return the scene as laser and camera see it."""
        if self.occlusion:
            scene = Visible(scene, model)
        return scene if self.falloff_mm is None else Falloff(scene, model.range_limits_mm[0])
