"""What is wrong with a recording or its settings, seen from its events and points."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from eschorty_ros.core.evt3 import Decoder
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.modulation.frequency_estimate import FrequencyEstimate
from eschorty_ros.core.reconstruction.missing_points import cause_of_few, without_modulation
from eschorty_ros.core.reconstruction.settings import Settings
from eschorty_ros.core.reconstruction.stage_faults import sampling_faults, stage_faults
from eschorty_ros.core.storage import Points, Recording
from eschorty_ros.core.storage.raw_file import RawReader

# Bytes that show the frequency, more where they hold few turns of it: lamps have near ones.
_PIECE_BYTES, _PIECES_MAX = 1 << 23, 8
_TURNS_ENOUGH = 60
# So many events of a chunk show what all do.
_CHUNK_BYTES = 1 << 19
_CHUNK_EVENTS = 1 << 15
# Points whose median sigma is that of all.
_SIGMAS = 1 << 16
# Difference of a multiple of the frequency from a whole one.
_WHOLE = 0.01
# Latency of pixels, part of a period by which events may seem to be before their edge, and the
# least period in which the latency does not hide it.
_LATENCY_MAX_US, _EARLY_SHARE = 1000.0, 1.0 / 16.0
_EDGE_PERIOD_MIN_US = 2.0 * _LATENCY_MAX_US
# Part of the period by which the mean times of ON and OFF events may be off: in a dark room pixels
# fall slowly.
_DUTY_APART = 0.2


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
    of_stream: list[str],
) -> list[str]:
    """Return one line for each contradiction and for the cause of a cloud with few points.

    A wrong frequency comes first: warnings of the stream follow from it.

    - ``counters``: See `Result`.
    - ``points``: The cloud, of POINT_DTYPE.
    - ``span_us``: Sensor times of the first and the last event, ``None`` without events.
    - ``shown``: See `shown_modulation`.
    - ``of_stream``: Warnings of the `Reconstructor`.
    """
    found = recording.scan.faults if recording.scan is not None else []
    if span_us is None:
        return [*of_stream, *found, f"no points: {without_modulation(0, 0.0)}"]
    stated_hz, shown_hz = recording.modulation.frequency_hz, shown.frequency_hz
    if recording.calibration_replaced:
        found.append(
            f"the recording is of {recording.calibration_replaced} and reconstructed with "
            f"{recording.calibration.name}; check that this is its instrument"
        )
    samples = recording.stage_samples
    found += stage_faults(recording, span_us)
    if len(points):
        sigma_mm = 1e3 * float(np.median(points["sigma"][:: len(points) // _SIGMAS + 1]))
        found += sampling_faults(recording, span_us, sigma_mm)
    wrong_frequency = []
    if shown_hz is not None and shown_hz != stated_hz:
        multiple = stated_hz / shown_hz
        whole = multiple > 1.5 and abs(multiple - round(multiple)) < _WHOLE
        or_slow = f", or the pixels follow one period of {multiple:.0f}" if whole else ""
        wrong_frequency.append(
            f"the laser's frequency is given as {stated_hz:g} Hz and the events show "
            f"{shown_hz:.4g} Hz; correct it{or_slow}, or where it is right let the camera send "
            "fewer events: a full readout delays them"
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
    lines = [*wrong_frequency, *of_stream, *found, *_unused_edges(recording, settings, counters)]
    if without_stage or ((wrong_frequency or found) and len(points)):
        return lines
    dark = without_modulation(counters["events"], stated_hz)
    cause = cause_of_few(settings, counters, len(points), dark, shown_hz is not None)
    return [*lines, f"{len(points):,} points: {cause}"] if cause else lines


def _unused_edges(
    recording: Recording, settings: Settings, counters: Mapping[str, int]
) -> list[str]:
    """Return a line about edges of the stage; in a scan recorded with them they set the clock."""
    edges = counters["decoder_triggers"]
    before = recording.settings.get("trigger_source")
    if not edges or settings.trigger_source != "stage" or before == "stage":
        return []
    return [
        f"{edges:,} edges at the trigger input are not used: trigger_source is stage, whose edges "
        "set the clock of a live scan, and stage.csv has the sensor's time already; where they are "
        "the laser's, set it to laser"
    ]


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
