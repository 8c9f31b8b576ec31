"""A scene as the camera sees it: surfaces hide what lies behind them on its side of the sheet."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.optics import RangeModel
from eschorty_ros.simulation.scenes import Scene

_STEP_MM = 0.25
"""Stage travel between the rays that are cast; shadows end at its multiples."""


class Visible:
    """The part of a scene that the lens sees, a :class:`Scene`.

    The ray from each hit to the lens is compared with the scene's first surface in the same column
    at every stage position that it passes; behind its first surface a scene counts as solid.
    """

    def __init__(self, scene: Scene, model: RangeModel) -> None:
        self._scene = scene
        self._model = model
        self._surfaces: dict[int, Array] = {}
        self._hidden: dict[int, NDArray[np.bool_]] = {}

    def range_mm(self, stage_mm: ArrayLike, columns: ArrayLike, model: RangeModel) -> Array:
        """Return ranges as a :class:`Scene`; NaN for hits that the camera does not see."""
        column = np.atleast_1d(np.asarray(columns, dtype=np.int64))
        steps = np.rint(np.atleast_1d(stage_mm) / _STEP_MM).astype(np.int64)
        hidden = np.array([self._hidden_at(int(step))[column] for step in steps])
        return np.where(hidden, np.nan, self._scene.range_mm(stage_mm, columns, model))

    def reflectance(self, stage_mm: ArrayLike, columns: ArrayLike, model: RangeModel) -> Array:
        """Return the reflectance of every hit, seen or not."""
        return self._scene.reflectance(stage_mm, columns, model)

    def _hidden_at(self, step: int) -> NDArray[np.bool_]:
        """Return a mask of the columns whose hit at this stage step the camera does not see."""
        if step not in self._hidden:
            along_mm, beside_mm = self._model.pupil_mm
            nearest_mm, _ = self._model.range_limits_mm
            hit = self._surface(step)
            hidden = np.zeros(hit.size, dtype=bool)
            farthest = np.fmax.reduce(hit, initial=0.0)
            ray, behind = hit, 0
            # Until the ray is nearer than any point that the sensor images.
            while farthest > nearest_mm:
                behind += 1
                share = behind * _STEP_MM / beside_mm
                ray = hit - (hit - along_mm) * share
                farthest = np.fmax.reduce(ray, initial=0.0)
                hidden |= self._surface(step - behind) < ray
            self._hidden[step] = hidden
        return self._hidden[step]

    def _surface(self, step: int) -> Array:
        """Return the scene's range in every column at a stage step, cast once."""
        if step not in self._surfaces:
            every = np.arange(self._model.columns)
            at_mm = np.array([step * _STEP_MM])
            self._surfaces[step] = self._scene.range_mm(at_mm, every, self._model)[0]
        return self._surfaces[step]
