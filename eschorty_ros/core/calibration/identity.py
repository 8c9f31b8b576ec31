"""Whether two calibrations are of the same instrument."""

from __future__ import annotations

from eschorty_ros.core.base.errors import CalibrationError
from eschorty_ros.core.optics import Calibration

_SAME = {
    "name": "build",
    "columns": "sensor columns",
    "rows": "sensor rows",
    "pixel_um": "pixel pitch in um",
    "roi_px": "window that the camera reads out",
}


def refuse_other_instrument(candidate: Calibration, active: Calibration) -> None:
    """Refuse a calibration that was made with another sensor, window or build.

    Parameters
    ----------
    candidate, active : Calibration
        The one that is to replace, and the one that is in use.

    Raises
    ------
    CalibrationError
        Names the first key that differs and both values.
    """
    for key, meaning in _SAME.items():
        theirs, ours = getattr(candidate, key), getattr(active, key)
        if theirs != ours:
            raise CalibrationError(
                f"the calibration's {key} ({meaning}) is {theirs!r} and the instrument's "
                f"{ours!r}; load one made with this instrument, or start it with the other one"
            )
