"""Targets of a calibration straight from a recording."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from eschorty_ros.core.base.errors import FitError
from eschorty_ros.core.calibration.aggregate_frame import AggregateFrame
from eschorty_ros.core.calibration.moving_target import moving_target
from eschorty_ros.core.calibration.post_finder import find_posts
from eschorty_ros.core.calibration.post_matching import KnownTarget, PostMatch, match_posts
from eschorty_ros.core.calibration.targets import Targets
from eschorty_ros.core.evt3 import Decoder
from eschorty_ros.core.optics import Calibration, refuse_other_sensor
from eschorty_ros.core.reconstruction import reconstruct_recording
from eschorty_ros.core.storage import Recording
from eschorty_ros.core.storage.raw_file import RawReader

_CHUNK_BYTES = 1 << 20


def recorded_posts(
    events_path: Path,
    known: Sequence[KnownTarget],
    nominal: Calibration,
    progress: Callable[[int, int], Any] | None = None,
) -> PostMatch:
    """Find the posts in all events of a RAW file and match them to the known targets.

    - ``events_path``: Of posts that keep their range: the stage still, or moving along them.
    - ``nominal``: The design of the build that made the recording.
    - ``progress``: Called with bytes read so far and bytes in all.

    Raises ``CalibrationError`` when the design has another sensor than the events. Raises
    ``FitError`` when no post is found, or the posts agree with the ranges in more than one way.
    Raises ``FormatError`` when the event file is not EVT3.
    """
    reader = RawReader(events_path)
    refuse_other_sensor(str(events_path), *reader.header.named_size, nominal)
    frame = AggregateFrame(nominal.columns, nominal.rows)
    decoder = Decoder(nominal.columns, nominal.rows)
    total, done = events_path.stat().st_size, 0
    for chunk in reader.chunks(_CHUNK_BYTES):
        frame.add(decoder.decode(chunk))
        done += len(chunk)
        if progress is not None:
            progress(done, total)
    posts = find_posts(frame)
    if not posts:
        raise FitError(
            f"{events_path}: no post found in {frame.events} events; check laser, focus and "
            "that the posts cross the sheet"
        )
    return match_posts(posts, known, nominal.model())


def recorded_moving_target(
    recording: Recording,
    nominal: Calibration,
    range_at_zero_mm: float,
    *,
    range_per_stage: float = 1.0,
    sigma_at_zero_mm: float = 0.0,
    blocks: int = 1,
    progress: Callable[[int, int], Any] | None = None,
) -> Targets:
    """Return a target for every profile of a flat target that the stage moves along the range.

    - ``recording``: Of the target while the stage moves.
    - ``nominal``, ``progress``: As in `recorded_posts`.
    - ``range_at_zero_mm``, ``range_per_stage``, ``sigma_at_zero_mm``, ``blocks``: As in
      `moving_target`, which also lists the errors.
    """
    made = recording.calibration
    refuse_other_sensor(str(recording.path), made.columns, made.rows, nominal)
    profiles = reconstruct_recording(recording, progress=progress).profiles
    return moving_target(
        profiles,
        recording.stage.position_mm(profiles.t_us),
        range_at_zero_mm,
        range_per_stage=range_per_stage,
        sigma_at_zero_mm=sigma_at_zero_mm,
        blocks=blocks,
    )
