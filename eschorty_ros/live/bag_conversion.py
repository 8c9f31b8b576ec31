"""Bags to recordings, by the way of live packets, and recordings to bags."""

from __future__ import annotations

import math
import os
import shutil
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from eschorty_ros.core.base.errors import ArgumentError, CalibrationError, FormatError
from eschorty_ros.core.base.numbers import file_path, short
from eschorty_ros.core.base.progress import Progress
from eschorty_ros.core.base.schema import validate
from eschorty_ros.core.base.yaml_file import Document, parse_yaml
from eschorty_ros.core.clocks import NS_PER_US, POSITION_LIMIT_MM, StageTrack
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import Calibration, refuse_other_sensor
from eschorty_ros.core.reconstruction import Settings
from eschorty_ros.core.storage import Recording, ScanLog
from eschorty_ros.core.storage.raw_file import RawReader
from eschorty_ros.live.bag_files import (
    CALIBRATION,
    CLOCK,
    EVENTS,
    LASER,
    ODOMETRY,
    TRIGGER,
    BagReader,
    BagWriter,
    stamp,
)
from eschorty_ros.live.device_messages import (
    MM_PER_M,
    LaserSettings,
    laser_settings,
    ns_from_stamp,
    pulse_train,
)
from eschorty_ros.live.packet_stream import PacketStream
from eschorty_ros.live.packet_times import Packet, check_span
from eschorty_ros.live.recorded_packets import timed_packets
from eschorty_ros.live.scan_recorder import ScanRecorder

_SCAN, _SETTINGS = "eschorty_scan", "eschorty_settings"
_DISK_S = 600.0
# Packets of which one has a larger seq than the first; two may have changed places.
_NUMBERS = 20


def bag_to_recording(
    bag: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    calibration: Calibration | None = None,
    frequency_hz: float | None = None,
    settings: dict[str, Any] | None = None,
    packet_period_s: float = 0.0,
) -> str:
    """Write a recording with the packets, stage and laser of a bag; return what it lacks.

    The clock of the sensor is estimated as the nodes do: announced on ``camera/clock``, else from
    the stage's edges, else from the packets' stamps.

    - ``bag``: Folder of a rosbag2, or one ``.mcap`` or ``.db3`` file.
    - ``folder``: The recording, made here.
    - ``calibration``: That of the bag when left out.
    - ``frequency_hz``: Of the laser, for a bag without ``laser/state``.
    - ``settings``: Settings of the reconstruction; the others are those of the recorded scan. Where
      the stage gives pulses, ``trigger_source`` is ``stage`` if neither has it.
    - ``packet_period_s``: Time over which the camera collects events before it sends them.

    Raises ``FormatError`` or ``ArgumentError`` or ``CalibrationError`` when the bag cannot be read
    or lacks something, or the recording cannot be written.
    """
    path = file_path("bag", bag)
    with BagReader(path) as source:
        _check(source, calibration, frequency_hz)
        custom = source.custom
        chosen = _from_custom(path, custom, _SETTINGS).data | (settings or {})
        if any(message.fields.count for message in source.messages(TRIGGER)):
            chosen.setdefault("trigger_source", "stage")
        limits = {"start_mm": -POSITION_LIMIT_MM, "stop_mm": POSITION_LIMIT_MM}
        scan = _from_custom(path, custom, _SCAN)
        named = {"scan_id": path.stem, **limits, "state": "ended", **scan.data}
        recorded = validate(ScanLog, replace(scan, data=named), FormatError)
        log = replace(recorded, state="recording")
        build = calibration or _calibration(source)
        stream = PacketStream(build, Settings.from_file(chosen, path), 0.0, packet_period_s)
        stream.announcement_expected = False
        if frequency_hz is not None:
            stream.set_laser(Modulation(frequency_hz), None)
        kinds = (CLOCK, TRIGGER, *([LASER] if frequency_hz is None else []))
        _latched(source, stream, kinds)
        target = file_path("folder", folder)
        recorder = ScanRecorder(target, log, build, chosen, waits=True)
        if fault := recorder.made(_DISK_S):
            raise ArgumentError(fault)
        stream.begin_scan(recorder)
        try:
            _play(source, stream, recorder, kinds)
            if not stream.packets:
                raise FormatError(f"{path} has no packet with a laser state; give --frequency")
            # Lost packets are counted again.
            recorder.end(None, "; ".join(replace(recorded, packets_lost=0).faults))
            lacking = recorder.wait(_DISK_S)
            if recorder.failure:
                raise FormatError(recorder.failure)
        except BaseException:
            try:
                recorder.end(None)
                recorder.wait(_DISK_S)
            finally:
                # Half a recording would look complete, also where a second signal ends the wait.
                shutil.rmtree(target, ignore_errors=True)
            raise
    return lacking


def _check(source: BagReader, calibration: Calibration | None, frequency_hz: float | None) -> None:
    for kind, missing, remedy in (
        (EVENTS, True, "record the camera's events"),
        (ODOMETRY, True, "record stage/odom"),
        (LASER, frequency_hz is None, "record laser/state, or give --frequency"),
        (CALIBRATION, calibration is None, "record reconstruction/calibration, or give "
         "--calibration"),
    ):  # fmt: skip
        if missing and kind not in source:
            raise FormatError(f"{source.path} has no {kind}; {remedy}")
    first = islice(source.messages(EVENTS), _NUMBERS)
    numbers = [message.fields.seq for message in first]
    if len(numbers) > 1 and max(numbers) == numbers[0]:
        raise FormatError(
            f"{source.path}: seq of the event packets does not increase from {numbers[0]} on; "
            "let the camera's driver count them"
        )


def _from_custom(path: Path, custom: dict[str, str], key: str) -> Document:
    found = parse_yaml(custom.get(key, "{}").encode(), path / "metadata.yaml", FormatError)
    if not isinstance(found.data, dict):
        raise FormatError(f"{path}: {key} is {short(found.data)}; remove it from metadata.yaml")
    return found


def _calibration(source: BagReader) -> Calibration:
    text = [message.fields.yaml for message in source.messages(CALIBRATION)][-1]
    document = parse_yaml(text.encode(), source.path, CalibrationError)
    return validate(Calibration, document, CalibrationError)


def _latched(source: BagReader, stream: PacketStream, kinds: tuple[str, ...]) -> None:
    """Set what was latched before the bag began: the first message of each kind."""
    for kind in kinds:
        if (message := next(iter(source.messages(kind)), None)) is None:
            continue
        if kind == LASER:
            laser = _laser(source, message.fields)
            stream.set_laser(laser.modulation, laser.epoch_ns)
        else:
            _set(source, stream, kind, message.fields)


def _laser(source: BagReader, fields: Any) -> LaserSettings:
    try:
        return laser_settings(fields)
    except ArgumentError as error:
        raise FormatError(f"{source.path}: laser/state: {error}, or give --frequency") from error


def _set(source: BagReader, stream: PacketStream, kind: str, fields: Any) -> None:
    if kind == CLOCK:
        stream.announce_zero(ns_from_stamp(fields.header.stamp) - ns_from_stamp(fields.time_ref))
    elif kind == TRIGGER:
        stream.set_pulses(pulse_train(fields))
    else:
        stream.set_laser(*_laser(source, fields))


def _play(
    source: BagReader, stream: PacketStream, recorder: ScanRecorder, kinds: tuple[str, ...]
) -> None:
    track = StageTrack()
    for message in source.messages(EVENTS, ODOMETRY, *kinds):
        fields = message.fields
        if message.kind == ODOMETRY:
            t_ns = ns_from_stamp(fields.header.stamp)
            position_mm = fields.pose.pose.position.y * MM_PER_M
            track.append(t_ns // NS_PER_US, position_mm)
            recorder.stage(t_ns, position_mm)
        elif message.kind in kinds:
            _set(source, stream, message.kind, fields)
        else:
            if fields.encoding != "evt3":
                raise FormatError(
                    f"{source.path}: encoding is {short(fields.encoding)}; record evt3"
                )
            name = f"a packet of {source.path}"
            size = fields.width, fields.height
            refuse_other_sensor(name, *size, stream.calibration, larger=True)
            check_span(fields.events)
            t_ns = ns_from_stamp(fields.header.stamp)
            packet = Packet(int(fields.seq), t_ns, memoryview(fields.events))
            stream.add(packet, message.t_ns * 1e-9)
            stream.process(message.t_ns * 1e-9)
            stream.fit_edges(track)
    stream.fit_edges(track, now=True)


def recording_to_bag(
    recording: Recording,
    bag: str | os.PathLike[str],
    storage: str = "mcap",
    progress: Progress | None = None,
) -> None:
    """Write a recording as a bag with the topics of camera, stage and laser.

    The camera's clock is announced, so that the way back is exact. Sensor time 0 is the time at
    which the recording's events were written, less their length.

    - ``bag``: Folder of the bag, made here.
    - ``storage``: ``mcap`` or ``sqlite3``.
    - ``progress``: See `Progress`.

    Raises ``ArgumentError`` when the bag exists or cannot be written.
    """
    path = file_path("bag", bag)
    custom = {}
    if recording.scan is not None:
        custom[_SCAN] = yaml.safe_dump(recording.scan.as_dict())
        custom[_SETTINGS] = yaml.safe_dump(recording.settings)
    try:
        with BagWriter(path, storage, custom) as target:
            _write(recording, target, progress)
    except OSError as error:
        raise ArgumentError(
            f"cannot write {path}: {error.strerror or error}; choose another folder"
        ) from error


def _write(recording: Recording, target: BagWriter, progress: Progress | None) -> None:
    rows = recording.stage_samples
    written_us = recording.events_path.stat().st_mtime_ns // NS_PER_US
    zero_ns = (written_us - int(np.ptp(rows["t_us"]))) * NS_PER_US
    begin_ns = zero_ns + min(int(rows["t_us"][0]), 0) * NS_PER_US
    total = recording.events_path.stat().st_size
    build, modulation = recording.calibration, recording.modulation
    target.write(CLOCK, begin_ns, header={"stamp": stamp(zero_ns)})
    near_mm, far_mm = build.range_mm or (math.nan, math.nan)
    target.write(
        CALIBRATION, begin_ns, header={"stamp": stamp(begin_ns)}, name=build.name,
        columns=build.columns, rows=build.rows, yaml=yaml.safe_dump(build.as_dict()),
        residual_rms=math.nan if build.residual_rms_px is None else build.residual_rms_px,
        range_min=near_mm / MM_PER_M, range_max=far_mm / MM_PER_M,
    )  # fmt: skip

    def laser(t_ns: int, on: bool) -> None:
        edge_us = modulation.on_edge_us
        target.write(
            LASER, t_ns, header={"stamp": stamp(t_ns)}, requested=on, output=on,
            output_since=stamp(t_ns), waveform=modulation.waveform,
            frequency=modulation.frequency_hz, duty=modulation.duty, reason="a recording",
            phase_epoch=stamp(0 if edge_us is None else zero_ns + edge_us * NS_PER_US),
        )  # fmt: skip

    laser(begin_ns, not recording.marks["laser_on"].any())
    reader, row, seq, done = RawReader(recording.events_path), 0, 0, 0
    width, height = reader.header.named_size

    def stage(until_us: int) -> None:
        nonlocal row
        while row < len(rows) and rows["t_us"][row] <= until_us:
            t_ns = zero_ns + int(rows["t_us"][row]) * NS_PER_US
            position = {"position": {"y": float(rows["position_mm"][row]) / MM_PER_M}}
            target.write(
                ODOMETRY, t_ns, header={"stamp": stamp(t_ns), "frame_id": "eschorty_base"},
                child_frame_id="eschorty_stage",
                pose={"pose": position | {"orientation": {"w": 1.0}}},
            )  # fmt: skip
            row += 1

    for packet in timed_packets(reader, recording.marks):
        stage(packet.until_us)
        t_ns = zero_ns + packet.from_us * NS_PER_US
        if packet.laser_on:
            laser(t_ns, True)
        seq += packet.packets_lost
        target.write(
            EVENTS, t_ns, header={"stamp": stamp(t_ns), "frame_id": "eschorty_optical"},
            height=height, width=width, seq=seq, encoding="evt3",
            events=np.frombuffer(packet.data, np.uint8),
        )  # fmt: skip
        seq += 1
        done += len(packet.data)
        if progress is not None:
            progress(done / total, "")
    stage(int(rows["t_us"][-1]))
