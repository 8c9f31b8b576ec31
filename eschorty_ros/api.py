"""A recording to a cloud in one call."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.optics import Calibration, load_calibration
from eschorty_ros.core.reconstruction import (
    Profiles,
    Settings,
    reconstruct_recording,
    recorded_settings,
)
from eschorty_ros.core.storage import Recording, load_recording, write_cloud
from eschorty_ros.report.accuracy import Accuracy, measure_recorded


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Cloud:
    """The points of a recording.

    Attributes
    ----------
    points : ndarray of POINT_DTYPE, or REFLECTANCE_DTYPE with the setting ``reflectance``
        In ``eschorty_base``, metres; ``t`` in seconds since the first event.
    profiles : Profiles
        The same points with rows, ranges in mm and sensor times.
    warnings : tuple of str
        One line for each contradiction in the recording, and for the cause of few points.
    counters : dict of str to int
        What became of the events.
    recording : Recording
    organized : ndarray, shape (profiles, columns), or None
        The points as a height map, with the setting ``organized``.
    """

    points: NDArray[np.void]
    profiles: Profiles
    warnings: tuple[str, ...]
    counters: dict[str, int]
    recording: Recording
    organized: NDArray[np.void] | None = None

    def __repr__(self) -> str:
        counts = f"{len(self.points):,} points, {self.profiles.profile_count:,} profiles"
        return f"Cloud({counts}, {len(self.warnings)} warnings)"

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the points as ``.pcd`` or ``.ply``; without points an ArgumentError."""
        if not len(self.points):
            raise ArgumentError(f"the cloud has 0 points; {path} is not written, see its warnings")
        write_cloud(path, self.points if self.organized is None else self.organized)

    def score(self) -> Accuracy | None:
        """Return the errors against ``truth.csv``, ``None`` where the recording has none."""
        return measure_recorded(self.points, self.profiles, self.recording)


def reconstruct(
    recording: str | os.PathLike[str] | Recording,
    *,
    progress: Callable[[int, int], Any] | None = None,
    calibration: str | os.PathLike[str] | Calibration | None = None,
    frequency_hz: float | None = None,
    **settings: Any,
) -> Cloud:
    """Return the cloud of a recording.

    Parameters
    ----------
    recording : path or Recording
        A recording's folder.
    progress : callable, optional
        Called with bytes read so far and bytes in all.
    calibration : name, path or Calibration, optional
        Instead of the recording's.
    frequency_hz : float, optional
        Of the laser, instead of the recording's.
    **settings
        Fields of `Settings`, such as ``centroid="median"``; the others are those of the recorded
        scan, or the defaults.

    Raises
    ------
    ArgumentError
        For a setting that does not exist or is out of bounds.
    FormatError, CalibrationError
        When a file of the recording is missing or malformed.
    """
    unknown = sorted(settings.keys() - {field.name for field in fields(Settings)})
    if unknown:
        raise ArgumentError(f"there is no setting {unknown[0]!r}; `help(es.Settings)` lists them")
    if not (calibration is None or isinstance(calibration, Calibration)):
        calibration = load_calibration(calibration)
    if isinstance(recording, Recording):
        loaded = recording.corrected(calibration, frequency_hz)
    else:
        loaded = load_recording(recording, calibration, frequency_hz)
    chosen = replace(recorded_settings(loaded), **settings)
    found = reconstruct_recording(loaded, chosen, progress)
    return Cloud(
        found.points,
        found.profiles,
        found.warnings,
        found.counters,
        loaded,
        found.organized,
    )
