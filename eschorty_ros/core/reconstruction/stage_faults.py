"""Contradictions between the stage's positions and the events of a recording."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.storage import Recording
from eschorty_ros.core.storage.recording import between

# Longest travel of a stage and largest position in metres, and what the readings of one at rest
# differ by.
_METRES_MAX, _METRES_FAR = 0.3, 1.0
_REST_MM = 0.003
# Part of the stage's travel and time that may be after the last event: camera and stage do not end
# at once.
_LEFT_SHARE = 0.02
_LEFT_US = 100_000
# Speed of a jump, mm/s and over that of the sweep.
_FAST_MM_S, _JUMP = 1000.0, 10.0
# Both steps of a sample that leaves and returns, over those of the sweep.
_RETURN = 4.0
# Times that the stage's log may be longer than the events.
_OTHER_UNIT = 100


def stage_faults(recording: Recording, span_us: tuple[int, int]) -> list[str]:
    """Return one line for each contradiction between the stage's positions and the events' time.

    - ``span_us``: Sensor times of the first and the last event.
    """
    t_us, position_mm = (recording.stage_samples[name] for name in ("t_us", "position_mm"))
    found, name = [], recording.events_path.name
    travel_mm = float(np.ptp(position_mm))
    if _REST_MM < travel_mm <= _METRES_MAX and np.abs(position_mm).max() < _METRES_FAR:
        found.append(
            f"the stage moves by {travel_mm:.3g} mm in stage.csv; where these are metres, write mm"
        )
    if travel_mm <= _REST_MM and t_us.size > 1:
        found.append(
            f"the stage stays at {position_mm[0]:.6g} mm in stage.csv: all profiles are in one "
            "place; where it moved, give its positions"
        )
    jump = _jump(t_us, position_mm)
    if jump is not None:
        found.append(
            f"the stage jumps from {position_mm[jump]:.6g} to {position_mm[jump + 1]:.6g} mm at "
            f"{t_us[jump + 1] * 1e-6:.3f} s in stage.csv; remove the sample that is wrong"
        )
    least_mm = max(_LEFT_SHARE * travel_mm, _REST_MM)
    begin_us, end_us = span_us
    if t_us[0] > end_us or t_us[-1] < begin_us:
        # Another line says that they do not overlap.
        return found
    logged_us, events_us = int(t_us[-1] - t_us[0]), end_us - begin_us
    if logged_us > _OTHER_UNIT * events_us:
        found.append(
            f"stage.csv covers {logged_us * 1e-6:.3g} s and the events {events_us * 1e-6:.3g} s; "
            f"write the times of both in microseconds, or copy {name} again"
        )
        return found
    after = position_mm[np.searchsorted(t_us, end_us + _LEFT_US) :]
    ended = recording.scan is not None and recording.scan.reason
    if after.size and np.ptp(after) > least_mm and not ended:
        found.append(
            f"the events end at {end_us * 1e-6:.3f} s, and the stage moves {np.ptp(after):.3g} mm "
            f"after that; where these were scanned, too, {name} is cut: copy it again"
        )
    before = position_mm[: np.searchsorted(t_us, begin_us - _LEFT_US)]
    around = position_mm[slice(*np.searchsorted(t_us, (begin_us - _LEFT_US, begin_us + _LEFT_US)))]
    under_way = around.size > 1 and np.ptp(around) > _REST_MM
    if (scan := recording.scan) is not None:
        # Earlier sweeps, and the way to where it begins, outside start to stop, come before it.
        before = before[between(before, scan.start_mm, scan.stop_mm)]
        first = np.searchsorted(t_us, begin_us)
        under_way &= between(position_mm[first : first + 1], scan.start_mm, scan.stop_mm).all()
    if before.size and np.ptp(before) > least_mm and under_way:
        found.append(
            f"the events begin at {begin_us * 1e-6:.3f} s, and the stage has moved "
            f"{np.ptp(before):.3g} mm before; where these were scanned, too, the beginning of "
            f"{name} is missing: copy it again"
        )
    return found


def sampling_faults(recording: Recording, span_us: tuple[int, int], sigma_mm: float) -> list[str]:
    """Return a line where positions between the samples are off by more than ``sigma_mm``.

    Half-way in an interval h a constant acceleration a moves the stage by a h^2 / 8 from the line
    between two samples, and a is the change of speed from interval to interval over their time.
    """
    t_us, position_mm = (recording.stage_samples[name] for name in ("t_us", "position_mm"))
    interval_s = np.diff(t_us) * 1e-6
    speed_mm_s = np.diff(position_mm) / interval_s
    pair_s = 0.5 * (interval_s[1:] + interval_s[:-1])
    longer_s = np.maximum(interval_s[1:], interval_s[:-1])
    off_mm = np.abs(np.diff(speed_mm_s)) / pair_s * longer_s**2 / 8.0
    inside = (t_us >= span_us[0]) & (t_us <= span_us[1])
    if (scan := recording.scan) is not None:
        inside &= between(position_mm, scan.start_mm, scan.stop_mm)
    off_mm = np.where(inside[1:-1], off_mm, 0.0)
    if not off_mm.size or off_mm.max() <= sigma_mm or _jump(t_us, position_mm) is not None:
        return []
    worst = int(np.argmax(off_mm))
    return [
        f"the speed in stage.csv changes by {abs(speed_mm_s[worst + 1] - speed_mm_s[worst]):.3g} "
        f"mm/s at {t_us[worst + 1] * 1e-6:.3f} s from one sample to the next, so that positions "
        f"between them may be off by {off_mm[worst]:.2g} mm; log them more often"
    ]


def _jump(t_us: NDArray[np.int64], position_mm: NDArray[np.float64]) -> int | None:
    """Return the index before a wrong sample: one that is too fast, or leaves and returns."""
    if t_us.size < 2:
        return None
    steps_mm = np.diff(position_mm)
    sizes_mm = np.abs(steps_mm)
    speed_mm_s = sizes_mm / np.diff(t_us) * 1e6
    jump = int(np.argmax(speed_mm_s))
    if speed_mm_s[jump] > max(_JUMP * np.quantile(speed_mm_s, 0.9), _FAST_MM_S):
        return jump
    returns = steps_mm[:-1] * steps_mm[1:] < 0.0
    back_mm = np.minimum(sizes_mm[:-1], sizes_mm[1:])[returns]
    # Rest must not make the turn of a sweep look fast.
    moving_mm = sizes_mm[sizes_mm > _REST_MM]
    if back_mm.size and moving_mm.size and back_mm.max() > _RETURN * np.quantile(moving_mm, 0.9):
        return int(np.flatnonzero(returns)[np.argmax(back_mm)])
    return None
