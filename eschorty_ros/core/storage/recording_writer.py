"""A recording as it grows: at every moment what has been written is a valid one."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.files import GrowingFile
from eschorty_ros.core.base.yaml_file import write_yaml
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import Calibration, save_calibration
from eschorty_ros.core.storage.cloud import Points, write_cloud
from eschorty_ros.core.storage.raw_file import RawWriter
from eschorty_ros.core.storage.recording import (
    CALIBRATION_FILE,
    EVENTS_FILE,
    LASER_FILE,
    MARK_DTYPE,
    MARKS_FILE,
    SCAN_FILE,
    SETTINGS_FILE,
    STAGE_DTYPE,
    STAGE_FILE,
    ScanLog,
    csv_header,
    csv_lines,
    write_laser_yaml,
    write_stage_csv,
)

SCAN_CLOUD_FILE = "scan.pcd"
"""The cloud that the nodes published; `eschorty reconstruct` writes ``cloud.pcd`` beside it."""


class RecordingWriter:
    """Writes the recording of a scan; each call either writes all of its data or nothing.

    - ``folder``: Made here; it must not exist, or be empty.
    - ``settings``: Settings of the reconstruction.

    Raises ``ArgumentError`` or ``FormatError`` when the folder holds files already or cannot be
    written.
    """

    def __init__(
        self,
        folder: Path,
        calibration: Calibration,
        modulation: Modulation,
        scan: ScanLog,
        settings: Mapping[str, Any],
    ) -> None:
        self._path = folder
        make_recording_folder(folder)
        self._files = contextlib.ExitStack()
        try:
            save_calibration(calibration, folder / CALIBRATION_FILE)
            write_laser_yaml(folder / LASER_FILE, modulation)
            write_yaml(folder / SCAN_FILE, scan.as_dict())
            write_yaml(folder / SETTINGS_FILE, settings)
            raw = RawWriter(folder / EVENTS_FILE, calibration.columns, calibration.rows)
            self._raw = self._files.enter_context(raw)
            self._stage = self._table(STAGE_DTYPE, STAGE_FILE)
            self._marks = self._table(MARK_DTYPE, MARKS_FILE)
        except BaseException:
            self._files.close()
            raise
        self._stage_us: int | None = None

    def events(self, data: Any) -> None:
        """Append bytes of the stream."""
        self._raw.write(data)

    def mark(self, packets_lost: int, laser_on: bool) -> None:
        """Note lost packets, or that the laser was switched on, before the next ``events``."""
        row = np.array([(self._raw.bytes_written, packets_lost, laser_on)], MARK_DTYPE)
        self._marks.write(csv_lines(row))

    def stage(self, t_us: int, position_mm: float) -> None:
        """Append a stage sample; one that is not later than the one before is left out."""
        if self._stage_us is None or t_us > self._stage_us:
            self._stage.write(csv_lines(np.array([(t_us, position_mm)], STAGE_DTYPE)))
            self._stage_us = t_us

    def replace_stage(self, samples: NDArray[np.void]) -> None:
        """Write two or more stage samples (STAGE_DTYPE) again, by a clock that is known better."""
        write_stage_csv(self._path / STAGE_FILE, samples["t_us"], samples["position_mm"])

    def end(self, scan: ScanLog, points: Points | None) -> None:
        """Write what is known at the end of a scan: its log and its cloud."""
        write_yaml(self._path / SCAN_FILE, scan.as_dict())
        if points is not None and len(points):
            write_cloud(self._path / SCAN_CLOUD_FILE, points)

    def close(self) -> None:
        """Close the files; idempotent."""
        self._files.close()

    def _table(self, dtype: np.dtype[Any], name: str) -> GrowingFile:
        table = self._files.enter_context(GrowingFile(self._path / name))
        table.write(csv_header(dtype))
        return table


def make_recording_folder(folder: Path) -> None:
    """Make a recording's folder; ArgumentError when it holds files or cannot be made."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        filled = any(folder.iterdir())
    except OSError as error:
        raise ArgumentError(
            f"cannot record into {folder}: {error.strerror or error}; choose another folder"
        ) from error
    if filled:
        raise ArgumentError(f"cannot record into {folder}: it is not empty; choose another folder")
