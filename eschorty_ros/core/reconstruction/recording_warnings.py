"""What is wrong with a recording or its settings, seen from its events and points."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.evt3 import Decoder
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.modulation.frequency_estimate import FrequencyEstimate
from eschorty_ros.core.reconstruction.settings import Settings
from eschorty_ros.core.reconstruction.stream_faults import is_unreadable
from eschorty_ros.core.storage import Points, Recording
from eschorty_ros.core.storage.raw_file import RawReader
from eschorty_ros.core.storage.recording import between

# Bytes that show the frequency, more where they hold few turns of it: lamps have near ones.
_PIECE_BYTES, _PIECES_MAX = 1 << 23, 8
_TURNS_ENOUGH = 60
# So many events of a chunk show what all do.
_CHUNK_BYTES = 1 << 19
_CHUNK_EVENTS = 1 << 15
_FEW = 10
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
# Difference of a multiple of the frequency from a whole one.
_WHOLE = 0.01
# Latency of pixels, part of a period by which events may seem to be before their edge, and the
# least period in which the latency does not hide it.
_LATENCY_MAX_US, _EARLY_SHARE = 1000.0, 1.0 / 16.0
_EDGE_PERIOD_MIN_US = 2.0 * _LATENCY_MAX_US
# Part of the period by which the mean times of ON and OFF events may be off: in a dark room pixels
# fall slowly.
_DUTY_APART = 0.2
_LOSSES = {
    "columns_too_few_events": "columns have fewer events than events_min = {0.events_min}; lower "
    "it, or raise periods_per_profile = {0.periods_per_profile}",
    "columns_isolated": "columns have no neighbour within isolation_gate_px = "
    "{0.isolation_gate_px:g}; raise it, or lower isolation_events = {0.isolation_events}",
    "columns_ambiguous": "columns have two equally strong lines; set returns to all",
    "points_beyond_pole": "points are beyond the last range of the calibration; check it",
    "points_outside_roi": "points are outside range_min and range_max; widen them",
    "points_outside_scan": "points are outside start to stop of the recorded scan; check the "
    "stage's positions",
}
"""Losses after which no point is left, with what to do; ``{0}`` are the settings."""
_FILTERED = "events are removed by noise_filter = {0.noise_filter}; set it to none"


class Shown(NamedTuple):
    """What the events show of the laser, an edge and the duty at its frequency; ``None`` if not."""

    frequency_hz: float | None
    edge_us: int | None
    duty: float | None


def shown_modulation(recording: Recording) -> Shown:
    """Return what the middle of the events shows of the laser's modulation."""
    reader, estimate = RawReader(recording.events_path), FrequencyEstimate()
    header = reader.header
    decoder = Decoder(header.width, header.height)
    begin = max(reader.size_bytes - header.size_bytes - _PIECE_BYTES, 0) // 4 * 2
    done, first_us = 0, None
    for chunk in reader.chunks(_CHUNK_BYTES, begin):
        events = decoder.decode(chunk)
        every = max(len(events) // _CHUNK_EVENTS, 1)
        estimate.add(events.t[::every], events.p[::every])
        done += len(chunk)
        if len(events):
            first_us = int(events.t[0]) if first_us is None else first_us
            turns = (int(events.t[-1]) - first_us) / recording.modulation.period_us
            if done >= _PIECE_BYTES * (1 if turns > _TURNS_ENOUGH else _PIECES_MAX):
                break
    modulation = recording.modulation
    frequency_hz = estimate.frequency_hz(modulation.frequency_hz)
    return Shown(frequency_hz, estimate.edge_us(modulation), estimate.duty(modulation))


def recording_warnings(
    recording: Recording,
    settings: Settings,
    counters: Mapping[str, int],
    points: Points,
    span_us: tuple[int, int] | None,
    shown: Shown,
) -> list[str]:
    """Return one line for each contradiction and for the cause of a cloud with few points.

    - ``counters``: See `Result`.
    - ``points``: The cloud, of POINT_DTYPE.
    - ``span_us``: Sensor times of the first and the last event, ``None`` without events.
    - ``shown``: See `shown_modulation`.
    """
    found = recording.scan.faults if recording.scan is not None else []
    if span_us is None:
        return [*found, f"no points: {without_modulation(0, 0.0)}"]
    stated_hz, shown_hz = recording.modulation.frequency_hz, shown.frequency_hz
    if recording.calibration_replaced:
        found.append(
            f"the recording is of {recording.calibration_replaced} and reconstructed with "
            f"{recording.calibration.name}; check that this is its instrument"
        )
    samples = recording.stage_samples
    found += stage_faults(recording, span_us)
    if len(points):
        found += _sampling_faults(recording, span_us, float(np.median(points["sigma"])) * 1e3)
    if shown_hz is not None and shown_hz != stated_hz:
        multiple = stated_hz / shown_hz
        whole = multiple > 1.5 and abs(multiple - round(multiple)) < _WHOLE
        or_slow = f", or the pixels follow one period of {multiple:.0f}" if whole else ""
        found.append(
            f"the laser's frequency is given as {stated_hz:g} Hz and the events show "
            f"{shown_hz:.4g} Hz; correct it{or_slow}"
        )
    elif shown_hz is not None:
        duty = shown.duty
        # Without a point ON and OFF may be swapped, which shows the rest of the period.
        swapped = duty is not None and abs(1.0 - duty - recording.modulation.duty) < _DUTY_APART
        found += _duty_faults(recording.modulation, duty) if len(points) or not swapped else []
        if len(points) and not counters["triggers_used"]:
            found += _edge_faults(recording.modulation, shown.edge_us)
    without_stage = counters["points_without_stage"]
    if without_stage:
        first_us, last_us = samples["t_us"][[0, -1]]
        longest_s = float(np.diff(samples["t_us"]).max()) * 1e-6
        gapped = recording.scan is not None and 0.0 < recording.scan.stage_gap_s < longest_s
        gaps = f" with gaps of up to {longest_s:.3g} s" if gapped else ""
        found.append(
            f"stage.csv covers {first_us * 1e-6:.3f} to {last_us * 1e-6:.3f} s of "
            f"{span_us[0] * 1e-6:.3f} to {span_us[1] * 1e-6:.3f} s{gaps}: {without_stage:,} of "
            f"{len(points) + without_stage:,} points have no stage position; give the stage log "
            "of the same time"
        )
    if without_stage or (found and len(points)):
        return found
    dark = without_modulation(counters["events"], stated_hz)
    return [*found, *_few_points(settings, counters, points, dark, shown_hz is not None)]


def _duty_faults(modulation: Modulation, shown: float | None) -> list[str]:
    """Return a line where the duty is not the one that the events show; a sine shows none."""
    if shown is None or modulation.waveform == "sine":
        return []
    apart = abs((modulation.duty - shown + 0.5) % 1.0 - 0.5)
    if apart <= max(_DUTY_APART, _LATENCY_MAX_US / modulation.period_us):
        return []
    return [
        f"the laser's duty cycle is given as {modulation.duty:g} and the events show {shown:.2f}; "
        "correct it in laser.yaml, unless the pixels are as slow as that: points have times that "
        f"are wrong by {0.5 * apart * modulation.period_us:.0f} us"
    ]


def _edge_faults(modulation: Modulation, shown_us: int | None) -> list[str]:
    """Return a line where ``on_edge_us`` is after the edge that the events show, or far before."""
    period_us = modulation.period_us
    if shown_us is None or modulation.on_edge_us is None or period_us < _EDGE_PERIOD_MIN_US:
        return []
    late_us = (shown_us - modulation.on_edge_us + 0.5 * period_us) % period_us - 0.5 * period_us
    most_us = max(_LATENCY_MAX_US, 0.25 * period_us, modulation.middle_us)
    if -_EARLY_SHARE * period_us <= late_us <= most_us:
        return []
    return [
        f"on_edge_us in laser.yaml is {abs(late_us):.0f} us {'after' if late_us < 0 else 'before'} "
        "the edge that the events show, and points have wrong times; correct it, or remove it: "
        "the phase is then estimated"
    ]


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
            f"where t_us is in nanoseconds, write microseconds, else copy {name} again"
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
    if (scan := recording.scan) is not None:
        # The stage has run up to the sweep before its events.
        before = before[between(before, scan.start_mm, scan.stop_mm)]
    around = position_mm[slice(*np.searchsorted(t_us, (begin_us - _LEFT_US, begin_us + _LEFT_US)))]
    under_way = around.size > 1 and np.ptp(around) > _REST_MM
    if before.size and np.ptp(before) > least_mm and under_way:
        found.append(
            f"the events begin at {begin_us * 1e-6:.3f} s, and the stage has moved "
            f"{np.ptp(before):.3g} mm before; where these were scanned, too, the beginning of "
            f"{name} is missing: copy it again"
        )
    return found


def _sampling_faults(recording: Recording, span_us: tuple[int, int], sigma_mm: float) -> list[str]:
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


def without_modulation(events: int, frequency_hz: float) -> str:
    """Return the cause of few points where the laser's modulation is not in the events."""
    if not events:
        return "no events came; look at the camera, its lens cap and the laser"
    return (
        f"hardly any of {events:,} events follow the laser's modulation at {frequency_hz:g} Hz; "
        "look at its frequency, at the focus and at what the line falls on"
    )


def _few_points(
    settings: Settings, counters: Mapping[str, int], points: Points, dark: str, modulated: bool
) -> list[str]:
    """Return the largest loss where it left few points or none, ``dark`` where there is none."""
    outside = 2 * max(counters["events_gated"], counters["events_outside_roi"])
    if outside > counters["events"] or is_unreadable(counters):
        # The reconstructor has a line for it.
        return []
    lost = max(_LOSSES, key=lambda name: counters[name])
    if modulated and not len(points) and counters["columns_unmodulated"] > counters[lost]:
        # It has one for this, too.
        return []
    if 2 * counters["events_filtered"] > counters["events"]:
        words, count = _FILTERED, counters["events_filtered"]
    else:
        words, count = _LOSSES[lost], counters[lost]
        unused = counters["events_binned"] - float(points["intensity"].sum())
        # Background alone leaves columns with few events, too.
        if len(points) and unused < Settings().events_min * count:
            return []
    if len(points) and count <= _FEW * len(points):
        return []
    cause = f"{count:,} {words.format(settings)}" if modulated and count else dark
    return [f"{len(points):,} points: {cause}"]
