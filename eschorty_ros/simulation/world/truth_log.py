"""The true ranges, from the lit phases and the stage positions at their middle."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.optics import RangeModel
from eschorty_ros.core.storage import TRUTH_DTYPE
from eschorty_ros.simulation.scenes import Scene

_PHASES_KEPT = 1_000_000
_AT_ONCE = 256


class TruthLog:
    """Lit phases of a scene that is swept."""

    def __init__(self, scene: Scene, model: RangeModel) -> None:
        self._scene = scene
        self._model = model
        self._phases: deque[tuple[int, float]] = deque(maxlen=_PHASES_KEPT)

    def add(self, middle_us: int, stage_mm: float) -> None:
        """Add a lit phase by its middle; the last million are kept."""
        self._phases.append((middle_us, stage_mm))

    def table(self) -> NDArray[np.void]:
        """Return the true range per phase and column with its line on the sensor, TRUTH_DTYPE."""
        every = np.arange(self._model.columns)
        parts = [np.empty(0, dtype=TRUTH_DTYPE)]
        phases = list(self._phases)
        for k in range(0, len(phases), _AT_ONCE):
            t_us, stage_mm = zip(*phases[k : k + _AT_ONCE], strict=True)
            range_mm = self._scene.range_mm(np.array(stage_mm), every, self._model)
            row = self._model.row(range_mm, every)
            phase, column = np.nonzero((row >= 0.0) & (row <= self._model.rows - 1.0))
            part = np.empty(phase.size, dtype=TRUTH_DTYPE)
            part["t_us"] = np.array(t_us)[phase]
            part["column"] = column
            part["range_mm"] = range_mm[phase, column]
            parts.append(part)
        return np.concatenate(parts)
