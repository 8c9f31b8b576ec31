"""Objects and arrays the tables share."""

from __future__ import annotations

from typing import Any

import numpy as np

from eschorty_ros.core.modulation import modulation
from eschorty_ros.core.optics import calibration_file as calibration
from eschorty_ros.core.storage import cloud
from hostile.kinds import exactly, integers, path, whole

CALIBRATION = calibration.load_calibration("config_3")

MODEL = CALIBRATION.model()

LASER = modulation.Modulation(70.0, on_edge_us=0)

T_MAX = 1 << 62

N = 4

TIMES = np.arange(N, dtype=np.int64)

COLUMNS = np.arange(N, dtype=np.uint16)

ROWS = np.arange(N, dtype=np.uint16)

SIGNS = np.ones(N, np.uint8)

POINTS = np.zeros(N, cloud.POINT_DTYPE)

EVENTS = {"t": TIMES, "x": COLUMNS, "y": ROWS, "p": SIGNS}

EVENT_KINDS = {
    "t": exactly("i8", N),
    "x": exactly("u2", N),
    "y": exactly("u2", N),
    "p": exactly("u1", N),
}

POLARITY = integers(-1, 2, 255, size=N)

SIZE = {"width": whole(0, 2049), "height": whole(0, 2049)}


def method(make: Any, name: str) -> Any:
    """Call ``name`` of a fresh object."""
    return lambda **arguments: getattr(make(), name)(**arguments)


PATH_ONLY = {"path": path()}
