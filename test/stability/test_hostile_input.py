"""Hard case 26: whatever a caller hands to the core gives a valid result or one typed, named error.

The table covers every public function, constructor and method of ``eschorty_ros.core``; the test
at the end fails when one is missing. Arguments that are objects of the package itself (a
calibration, a modulation, a range model) are checked by the type checker, not here.
"""

from __future__ import annotations

import warnings
from functools import partial
from typing import Any

import numpy as np
import pytest
from hostile import (
    HUGE,
    Call,
    Kind,
    exactly,
    integers,
    number,
    octets,
    parameters,
    path,
    public_callables,
    reals,
    text,
    vector,
    whole,
)
from line_events import blank_profiles

from eschorty_ros.core import (
    calibration,
    calibration_fit,
    centroid,
    clock,
    cloud,
    design,
    evt3,
    files,
    finishing,
    held_events,
    modulation,
    motion,
    noise,
    optics,
    phase,
    phase_gate,
    profile_assembler,
    profiles,
    raw_file,
    reconstructor,
    recording,
    reference,
    reflectance,
    settings,
    smoothing,
    targets,
    yaml_file,
)
from eschorty_ros.core.errors import CalibrationError, EschortyError

HANDED_OUT = {
    "calibration_fit.CalibrationFit", "centroid.Centroids", "design.Design", "design.DesignTable",
    "evt3.Counters", "evt3.Events", "evt3.Triggers", "noise.FilterCounters", "offline.Result",
    "phase.PhaseEstimate", "profiles.Profiles", "raw_file.Header", "recording.Recording",
    "yaml_file.Schema",
}  # fmt: skip
"""Plain records that the package makes; nobody else has to."""
TESTED_ELSEWHERE = {
    # All their arguments are objects of the package, or they take none.
    "offline.reconstruct_recording", "warm_up.warm_up", "calibration.Calibration.model",
    "calibration.config_folders",
    # Every key of the file has its own test in test/core/test_calibration_file.py.
    "calibration.Calibration",
}  # fmt: skip
PACKAGE_OBJECTS = {
    "calibration", "date", "design", "drain", "error", "model", "modulation", "parts", "plan",
    "profiles", "progress", "schema", "settings",
}  # fmt: skip

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


def events_with(**changed: Any) -> evt3.Events:
    none = evt3.Triggers(TIMES[:0], SIGNS[:0], SIGNS[:0])
    return evt3.Events(**{**EVENTS, **changed}, triggers=none)


def method(make: Any, name: str) -> Any:
    """Call ``name`` of a fresh object."""
    return lambda **arguments: getattr(make(), name)(**arguments)


def on_model(name: str, **arguments: Any) -> Call:
    return Call(getattr(MODEL, name), arguments, dict.fromkeys(arguments, reals()))


def a_track() -> clock.StageTrack:
    track = clock.StageTrack()
    track.append([0, 10], [0.0, 1.0])
    return track


def a_schedule() -> phase.EdgeSchedule:
    schedule = phase.EdgeSchedule(LASER)
    schedule.anchor(0, 0)
    return schedule


def an_assembler() -> profile_assembler.ProfileAssembler:
    assembler = profile_assembler.ProfileAssembler(settings.Settings(), MODEL)
    assembler.restart(LASER)
    return assembler


def write_atomically(path: Any) -> None:
    with files.atomic_write(path) as stream:
        stream.write(b"x")


def raw_writer(path: Any = "events.raw", **arguments: Any) -> None:
    raw_file.RawWriter(path, **arguments).close()


def raw_write(data: Any) -> None:
    with raw_file.RawWriter("events.raw") as writer:
        writer.write(data)


def raw_chunks(size: Any) -> bytes:
    raw_writer()
    return b"".join(raw_file.RawReader("events.raw").chunks(size))


def blank_settings() -> dict[str, Any]:
    return {name: getattr(settings.Settings(), name) for name in parameters(settings.Settings)}


def settings_kind(value: Any) -> Kind:
    if isinstance(value, str):
        return text()
    return whole(-1) if isinstance(value, int) else number(-1e-9)


LENS = {"focal_length_mm": 24.0, "f_number": 2.0, "theta_deg": 85.87, "pixel_um": 4.86, "b_mm": 0.0}
LENS_KINDS = {
    "focal_length_mm": number(0.0), "f_number": number(0.0), "theta_deg": number(0.0, 91.0),
    "pixel_um": number(0.0), "b_mm": number(), "columns": whole(0), "rows": whole(0),
}  # fmt: skip
SIZES = {"columns": 1280, "rows": 720}
PATH_ONLY = {"path": path()}
FIT = {"row": [100.0, 300.0, 500.0], "range_mm": [860.0, 1064.0, 1395.0], "design": MODEL}
TARGET = dict.fromkeys(parameters(targets.Targets) - {"labels"}, 100.0)

CALLS: dict[str, Call] = {
    "calibration.load_calibration": Call(
        calibration.load_calibration,
        {"name_or_path": "config_3"},
        {"name_or_path": path()},
    ),
    "calibration.save_calibration": Call(
        partial(calibration.save_calibration, CALIBRATION), {"path": "c.yaml"}, PATH_ONLY
    ),
    "calibration_fit.CalibrationFit.range_sigma_mm": Call(
        calibration_fit.fit_targets(**FIT).range_sigma_mm,
        {"range_mm": [900.0, 1300.0]},
        {"range_mm": reals()},
    ),
    "calibration_fit.fit_targets": Call(
        calibration_fit.fit_targets,
        dict(
            FIT,
            free=("k_prime_px", "b_prime_px"),
            sigma_row_px=0.3,
            sigma_range_mm=0.0,
            prior_sigma=None,
        ),
        {
            "row": vector(-1.0, 720.0, size=3),
            "range_mm": vector(0.0, -5.0, size=3),
            "free": Kind([None, 3, "k", ["k_mm", "k_mm"], [], [3], [[]]]),
            "sigma_row_px": vector(0.0, -1.0, size=3),
            "sigma_range_mm": vector(-1.0, size=3),
            "prior_sigma": Kind(
                [{"k_mm": 1.0}, {"b_prime_px": 0.0}, {"b_prime_px": "a"}, 3, "k_mm"]
            ),
        },
    ),
    "centroid.half_width_fixed": Call(
        centroid.half_width_fixed, {"fwhm_px": 5.0}, {"fwhm_px": number(0.0)}
    ),
    "centroid.method_factor": Call(
        centroid.method_factor,
        {"method": "mean", "sigma_factor": 0.2},
        {"method": text(), "sigma_factor": number(-1.0)},
        {"method": "centroid"},
    ),
    "centroid.check_method": Call(
        centroid.check_method, {"method": "mean"}, {"method": text()}, {"method": "centroid"}
    ),
    "centroid.estimate": Call(
        centroid.estimate,
        {
            "rows": ROWS,
            "offsets": [0, 1, N],
            "method": "mode_mean",
            "line_width_px": 20.0,
            "height": 720,
            "events_min": 1,
            "sigma_factor": 0.24,
            "sigma_floor_px": 0.2,
        },
        {
            "rows": integers(-1, 720, 65535, 2**40, size=N),
            "offsets": integers(-1, 5, 2**40, size=2),
            "method": text(),
            "line_width_px": number(0.0, 721.0),
            "height": whole(0, 5000),
            "events_min": whole(0),
            "sigma_factor": number(-1.0),
            "sigma_floor_px": number(-1.0),
        },
        {"method": "centroid"},
    ),
    "clock.quantise_nm": Call(
        partial(clock.quantise_nm, name="position_mm"),
        {"position_mm": [1.0, 2.0]},
        {"position_mm": vector(2e9, -2e9, size=2, any_shape=True), "name": Kind([])},
    ),
    "clock.StageTrack": Call(
        clock.StageTrack, {"max_gap_us": 5}, {"max_gap_us": whole(0, optional=True)}
    ),
    "clock.StageTrack.append": Call(
        method(clock.StageTrack, "append"),
        {"t_us": TIMES, "position_mm": np.zeros(N)},
        {"t_us": integers(2**63, size=N), "position_mm": vector(2e9, size=N)},
    ),
    "clock.StageTrack.position_mm": Call(
        method(a_track, "position_mm"),
        {"t_us": [3, 4]},
        {"t_us": integers(2**63, size=2, any_shape=True)},
    ),
    "clock.StageTrack.forget_before": Call(
        method(a_track, "forget_before"), {"t_us": 3}, {"t_us": whole()}
    ),
    "clock.SensorClock": Call(
        clock.SensorClock,
        {"zero_ns": 5, "window_ns": 10},
        {"zero_ns": whole(optional=True), "window_ns": whole(0)},
    ),
    "clock.SensorClock.observe": Call(
        method(clock.SensorClock, "observe"),
        {"t_us": 5, "arrival_ns": 10},
        {"t_us": whole(), "arrival_ns": whole()},
    ),
    "clock.SensorClock.to_ns": Call(
        method(partial(clock.SensorClock, 7), "to_ns"), {"t_us": 3}, {"t_us": whole()}
    ),
    "clock.SensorClock.to_us": Call(
        method(partial(clock.SensorClock, 7), "to_us"), {"t_ns": 3}, {"t_ns": whole()}
    ),
    "cloud.write_cloud": Call(
        cloud.write_cloud,
        {"path": "c.pcd", "points": POINTS},
        {"path": path(), "points": Kind([None, 3, "abc", np.zeros(3), POINTS.reshape(2, 2)])},
    ),
    "cloud.read_cloud": Call(
        lambda path: (cloud.write_cloud("c.pcd", POINTS), cloud.read_cloud(path)),
        {"path": "c.pcd"},
        PATH_ONLY,
    ),
    "cloud.join_points": Call(
        cloud.join_points,
        {"parts": [POINTS, POINTS]},
        {"parts": Kind([[], None, 3, [3], [np.zeros(3)], "abc", [POINTS, None]])},
    ),
    "design.Design.at": Call(
        design.design(theta_prime_deg=-7.6, b_prime_px=-1100.0, **LENS).at,
        {"range_mm": [900.0, 1300.0]},
        {"range_mm": reals()},
    ),
    "design.design": Call(
        design.design,
        dict(
            LENS, **SIZES, theta_prime_deg=-7.6, baseline_mm=None, b_prime_px=-1100.0, near_mm=None
        ),
        dict(
            LENS_KINDS,
            theta_prime_deg=number(0.0, 91.0),
            baseline_mm=Kind([3.0, "abc"]),
            b_prime_px=number(0.0),
            near_mm=Kind([3.0, "abc"]),
        ),
    ),
    "design.design_for_ranges": Call(
        design.design_for_ranges,
        dict(LENS, **SIZES, near_mm=800.0, far_mm=2100.0),
        dict(LENS_KINDS, near_mm=number(0.0, 2100.0), far_mm=number(800.0)),
    ),
    "evt3.Encoder": Call(evt3.Encoder, {"width": 64, "height": 64}, SIZE),
    "evt3.Encoder.encode": Call(
        method(evt3.Encoder, "encode"),
        dict(EVENTS, trigger_t=[1], trigger_edge=[1]),
        {
            "t": integers(-1, T_MAX, size=N),
            "x": integers(-1, 1280, 65535, size=N),
            "y": integers(-1, 720, 65535, size=N),
            "p": POLARITY,
            "trigger_t": integers(-1, T_MAX, size=1),
            "trigger_edge": integers(-1, 2, size=1),
        },
    ),
    "evt3.Encoder.advance": Call(
        method(evt3.Encoder, "advance"), {"t_us": 5}, {"t_us": whole(-1, T_MAX)}
    ),
    "evt3.sort_readout": Call(
        evt3.sort_readout,
        EVENTS,
        {
            "t": integers(-1, T_MAX, size=N),
            "x": integers(-1, 2048, size=N),
            "y": integers(-1, 2048, size=N),
            "p": POLARITY,
        },
    ),
    "evt3.Events.packed": Call(events_with().packed, {}),
    "evt3.Decoder": Call(evt3.Decoder, {"width": 64, "height": 64}, SIZE),
    "evt3.Decoder.reset": Call(method(evt3.Decoder, "reset"), {}),
    "evt3.Decoder.note_gap": Call(method(evt3.Decoder, "note_gap"), {}),
    "evt3.Decoder.decode": Call(
        method(evt3.Decoder, "decode"), {"data": b"\x00\x80"}, {"data": octets()}
    ),
    "evt3.event_arrays": Call(evt3.event_arrays, {"size": 3}, {"size": whole(-1, 1 << 40)}),
    "files.atomic_write": Call(write_atomically, {"path": "a.txt"}, PATH_ONLY),
    "finishing.Finisher": Call(finishing.Finisher, {"settings": settings.Settings()}),
    "finishing.Finisher.push": Call(
        finishing.Finisher(settings.Settings()).push, {"profiles": blank_profiles(3)}
    ),
    "held_events.HeldEvents": Call(held_events.HeldEvents, {}),
    "held_events.HeldEvents.append": Call(
        method(held_events.HeldEvents, "append"), EVENTS, EVENT_KINDS
    ),
    "held_events.HeldEvents.drop": Call(
        method(held_events.HeldEvents, "drop"), {"count": 0}, {"count": whole(-1, 1)}
    ),
    "modulation.Modulation": Call(
        modulation.Modulation,
        {"frequency_hz": 70.0, "duty": 0.5, "waveform": "square", "on_edge_us": 0},
        {
            "frequency_hz": number(15.9, 20_001.0),
            "duty": number(0.0, 1.0),
            "waveform": text(),
            "on_edge_us": whole(T_MAX + 1, -T_MAX - 1, optional=True),
        },
    ),
    "modulation.Modulation.edge_us": Call(LASER.edge_us, {"index": 3}, {"index": whole()}),
    "motion.MotionPlan": Call(
        motion.MotionPlan,
        {
            "start_ns": 0,
            "position_mm": 0.0,
            "velocity_mm_s": 1.0,
            "durations_s": (1.0,),
            "accelerations_mm_s2": (2.0,),
        },
        {
            "start_ns": whole(),
            "position_mm": number(),
            "velocity_mm_s": number(),
            "durations_s": vector(-1.0, size=1),
            "accelerations_mm_s2": vector(size=1),
        },
    ),
    "motion.MotionPlan.state": Call(
        motion.plan_move(0, 0.0, 5.0, 1.0, 1.0).state,
        {"t_ns": [3, 4]},
        {"t_ns": integers(2**63, size=2, any_shape=True)},
    ),
    "motion.plan_move": Call(
        motion.plan_move,
        {
            "start_ns": 0,
            "position_mm": 0.0,
            "target_mm": 5.0,
            "speed_mm_s": 1.0,
            "acceleration_mm_s2": 1.0,
        },
        {
            "start_ns": whole(),
            "position_mm": number(),
            "target_mm": number(),
            "speed_mm_s": number(0.0),
            "acceleration_mm_s2": number(0.0),
        },
    ),
    "motion.plan_stop": Call(
        motion.plan_stop,
        {"plan": motion.plan_move(0, 0.0, 5.0, 1.0, 1.0), "at_ns": 10, "deceleration_mm_s2": 1.0},
        {"at_ns": whole(), "deceleration_mm_s2": number(0.0)},
    ),
    "noise.ActivityFilter": Call(
        noise.ActivityFilter,
        {"width": 64, "height": 64, "window_us": 5},
        dict(SIZE, window_us=whole(0, 1_000_001)),
    ),
    "noise.ActivityFilter.reset": Call(method(noise.ActivityFilter, "reset"), {}),
    "noise.ActivityFilter.filter": Call(
        lambda **changed: noise.ActivityFilter().filter(events_with(**changed)),
        EVENTS,
        EVENT_KINDS,
    ),
    "optics.object_scale_mm": Call(
        optics.object_scale_mm,
        {"focal_mm": 24.0, "theta_deg": 85.0},
        {"focal_mm": number(0.0), "theta_deg": number(0.0, 180.0)},
    ),
    "optics.depth_of_field_mm": Call(
        optics.depth_of_field_mm,
        {
            "magnification": [0.02],
            "f_number": 2.0,
            "theta_deg": 85.0,
            "theta_prime_deg": -7.0,
            "pixel_um": 5.0,
        },
        {
            "magnification": reals(),
            "f_number": number(0.0),
            "theta_deg": number(0.0),
            "theta_prime_deg": number(-91.0, 91.0),
            "pixel_um": number(0.0),
        },
    ),
    "optics.RangeModel": Call(
        optics.RangeModel,
        {
            "k_mm": 24.0,
            "k_prime_px": -37000.0,
            "b_mm": 0.0,
            "b_prime_px": -1140.0,
            "pixel_um": 4.86,
            "columns": 1280,
            "rows": 720,
            "principal_column": 639.5,
            "theta_deg": 85.87,
        },
        {
            "k_mm": number(0.0),
            "k_prime_px": number(0.0),
            "b_mm": number(),
            "b_prime_px": number(-0.5),
            "pixel_um": number(0.0),
            "columns": whole(0),
            "rows": whole(0),
            "principal_column": number(),
            "theta_deg": number(0.0, 91.0),
        },
    ),
    "optics.RangeModel.range_mm": on_model("range_mm", row=[3.0]),
    "optics.RangeModel.row": on_model("row", range_mm=[1300.0]),
    "optics.RangeModel.magnification": on_model("magnification", row=[3.0]),
    "optics.RangeModel.range_per_row_mm": on_model("range_per_row_mm", range_mm=[1300.0]),
    "optics.RangeModel.range_sigma_mm": on_model("range_sigma_mm", row=[3.0], sigma_row=[0.3]),
    "optics.RangeModel.column_slope": on_model("column_slope", column=[3.0]),
    "optics.RangeModel.lateral_mm": on_model("lateral_mm", column=[3.0], range_mm=[1300.0]),
    "optics.RangeModel.rows_per_mm_off_sheet": on_model("rows_per_mm_off_sheet", range_mm=[1300.0]),
    "phase.EdgeSchedule": Call(
        phase.EdgeSchedule, {"modulation": LASER, "every": 2}, {"every": whole(0)}
    ),
    "phase.EdgeSchedule.add_triggers": Call(
        method(a_schedule, "add_triggers"),
        {"t_us": TIMES},
        {"t_us": exactly("i8", N, alone=True)},
    ),
    "phase.EdgeSchedule.anchor": Call(
        method(a_schedule, "anchor"),
        {"edge_us": 5, "start_us": 10},
        {"edge_us": whole(T_MAX + 1), "start_us": whole(T_MAX + 1)},
    ),
    "phase.EdgeSchedule.jump": Call(
        method(a_schedule, "jump"), {"t_us": 5}, {"t_us": whole(T_MAX + 1)}
    ),
    "phase.EdgeSchedule.watermark_after": Call(
        method(a_schedule, "watermark_after"), {"newest_us": 5}, {"newest_us": whole(T_MAX + 1)}
    ),
    "phase.EdgeSchedule.advance": Call(
        method(a_schedule, "advance"),
        {"watermark_us": 50_000},
        {"watermark_us": whole(T_MAX + 1)},
    ),
    "phase.estimate_phase": Call(
        phase.estimate_phase,
        {"t_us": TIMES, "polarity": SIGNS, "modulation": LASER},
        {"t_us": integers(2**63, size=N), "polarity": POLARITY},
    ),
    "phase.decide_window": Call(
        phase.decide_window,
        {"t_us": np.arange(5000), "watermark_us": 10**6, "modulation": LASER},
        {"t_us": exactly("i8", 5000, alone=True), "watermark_us": whole()},
    ),
    "phase_gate.gate_parameters": Call(
        phase_gate.gate_parameters,
        {"modulation": LASER, "gate_us": 1000},
        {"gate_us": whole(-1, 100_001)},
    ),
    "profile_assembler.ProfileAssembler": Call(
        profile_assembler.ProfileAssembler, {"settings": settings.Settings(), "model": MODEL}
    ),
    "profile_assembler.ProfileAssembler.restart": Call(
        method(an_assembler, "restart"), {"modulation": LASER}
    ),
    "profile_assembler.ProfileAssembler.merge": Call(
        method(an_assembler, "merge"),
        dict(EVENTS, edges=TIMES[:2], indices=TIMES[:2], first_edge=0, drain=True),
        dict(
            EVENT_KINDS,
            edges=exactly("i8", 2, alone=True),
            indices=exactly("i8", 2),
            first_edge=whole(-1, 3),
        ),
    ),
    "profile_assembler.ProfileAssembler.close": Call(method(an_assembler, "close"), {}),
    "profile_assembler.ProfileAssembler.take": Call(method(an_assembler, "take"), {}),
    "profiles.Profiles.empty": Call(profiles.Profiles.empty, {}),
    "profiles.Profiles.concatenate": Call(
        profiles.Profiles.concatenate, {"parts": [blank_profiles(3)]}
    ),
    "profiles.Profiles.select": Call(
        blank_profiles(N).select,
        {"mask": [0, 1]},
        {"mask": Kind(["abc", [0.5], [float("nan")], [N], [-N - 1], [True], [HUGE]])},
    ),
    "profiles.place_link": Call(
        profiles.place_link,
        {"profiles": blank_profiles(N), "model": MODEL, "origin_us": 0},
        {"origin_us": whole(2**63)},
    ),
    "profiles.place": Call(
        profiles.place,
        {
            "profiles": blank_profiles(N),
            "model": MODEL,
            "stage_position_mm": np.zeros(N),
            "stage_direction": (0.0, 1.0, 0.0),
            "origin_us": 0,
        },
        {
            "stage_position_mm": Kind(["abc", None, np.zeros(N + 1), np.zeros((2, 2))], [np.nan]),
            "stage_direction": vector(0.0, 1.0, size=3),
            "origin_us": whole(2**63),
        },
    ),
    "raw_file.RawReader": Call(
        lambda path: (raw_writer(), raw_file.RawReader(path)), {"path": "events.raw"}, PATH_ONLY
    ),
    "raw_file.RawReader.chunks": Call(raw_chunks, {"size": 5}, {"size": whole(0)}),
    "raw_file.RawWriter": Call(
        raw_writer,
        {
            "path": "events.raw",
            "serial": "00000000",
            "width": 64,
            "height": 64,
            "sensor_name": "IMX636",
        },
        dict(
            SIZE,
            path=path(),
            serial=Kind([None, 3, "xyz", ""]),
            sensor_name=Kind([None, 3, "two words", "", "ü"]),
        ),
    ),
    "raw_file.RawWriter.write": Call(raw_write, {"data": b"abc"}, {"data": octets()}),
    "raw_file.RawWriter.close": Call(raw_writer, {}),
    "reconstructor.Reconstructor": Call(
        reconstructor.Reconstructor,
        {"calibration": CALIBRATION, "modulation": LASER, "settings": settings.Settings()},
    ),
    "reconstructor.Reconstructor.push": Call(
        method(partial(reconstructor.Reconstructor, CALIBRATION, LASER), "push"),
        {"data": b"\x00\x80"},
        {"data": octets()},
    ),
    "reconstructor.Reconstructor.flush": Call(
        method(partial(reconstructor.Reconstructor, CALIBRATION, LASER), "flush"), {}
    ),
    "reconstructor.Reconstructor.note_gap": Call(
        method(partial(reconstructor.Reconstructor, CALIBRATION, LASER), "note_gap"), {}
    ),
    "reconstructor.Reconstructor.set_modulation": Call(
        method(partial(reconstructor.Reconstructor, CALIBRATION, LASER), "set_modulation"),
        {"modulation": modulation.Modulation(80.0)},
    ),
    "recording.load_recording": Call(recording.load_recording, {}, PATH_ONLY),
    "recording.read_laser_yaml": Call(
        lambda path: (
            recording.write_laser_yaml("laser.yaml", LASER),
            recording.read_laser_yaml(path),
        ),
        {"path": "laser.yaml"},
        PATH_ONLY,
    ),
    "recording.write_laser_yaml": Call(
        partial(recording.write_laser_yaml, modulation=LASER), {"path": "laser.yaml"}, PATH_ONLY
    ),
    "recording.write_stage_csv": Call(
        recording.write_stage_csv,
        {"path": "stage.csv", "t_us": TIMES, "position_mm": np.zeros(N)},
        {"path": path(), "t_us": integers(2**63, size=N), "position_mm": vector(2e9, size=N)},
    ),
    "recording.write_truth_csv": Call(
        recording.write_truth_csv,
        {"path": "truth.csv", "t_us": TIMES, "column": COLUMNS, "range_mm": np.zeros(N)},
        {
            "path": path(),
            "t_us": integers(2**63, size=N),
            "column": integers(-1, 65536, size=N),
            "range_mm": vector(2e9, size=N),
        },
    ),
    "reference.decode_all": Call(reference.decode_all, {"data": b"\x00\x80"}, {"data": octets()}),
    "reference.reconstruct": Call(
        reference.reconstruct,
        {
            "t_us": TIMES,
            "column": COLUMNS,
            "row": ROWS,
            "model": MODEL,
            "modulation": LASER,
            "events_min": 1,
        },
        {
            "t_us": integers(2**63, size=N),
            "column": integers(-1, 1280, size=N),
            "row": integers(-1, 720, size=N),
            "events_min": whole(0),
        },
    ),
    "reflectance.events_per_row": Call(
        reflectance.events_per_row,
        {"width_px": np.ones(N), "events": np.ones(N, np.uint32)},
        {"width_px": vector(-1.0, size=N), "events": integers(-1, size=N)},
    ),
    "reflectance.full_width2": Call(
        reflectance.full_width2,
        {"width_px": np.ones(N), "events": np.ones(N, np.uint32)},
        {"width_px": vector(-1.0, size=N), "events": integers(-1, size=N)},
    ),
    "reflectance.relative_reflectance": Call(
        reflectance.relative_reflectance,
        {
            "edge_us": np.zeros(N, np.int64),
            "width_px": np.ones(N),
            "events": np.ones(N, np.uint32),
            "footprint_sigma_px": 4.0,
            "white_width_px": 0.0,
        },
        {
            "edge_us": integers(2**63, size=N),
            "width_px": vector(-1.0, size=N),
            "events": integers(-1, size=N),
            "footprint_sigma_px": number(0.0),
            "white_width_px": number(-1.0),
        },
    ),
    "settings.Settings": Call(
        settings.Settings,
        blank_settings(),
        {name: settings_kind(value) for name, value in blank_settings().items()},
    ),
    "smoothing.smooth": Call(
        smoothing.smooth,
        {
            "row": np.ones(N),
            "sigma_row": np.ones(N),
            "half_width": 1,
            "gate_px": 2.0,
            "common_px": 0.1,
        },
        {
            "row": vector(finite=False, size=N),
            "sigma_row": vector(-1.0, finite=False, size=N),
            "half_width": whole(-1),
            "gate_px": number(-1.0),
            "common_px": number(-1.0),
        },
    ),
    "targets.Targets": Call(
        targets.Targets,
        dict(TARGET, labels=["a"]),
        dict(
            dict.fromkeys(TARGET, vector(-1.0, np.inf, finite=False)),
            row=vector(),
            column=vector(np.inf, finite=False),
            labels=Kind([[3], ["a", "b"], 3]),
        ),
    ),
    "targets.Targets.select": Call(
        targets.Targets(row=[1.0, 2.0], range_mm=[900.0, 901.0]).select,
        {"which": [1]},
        {"which": Kind(["abc", [0.5], [2], [-3], [True], None])},
    ),
    "targets.Targets.concatenate": Call(
        targets.Targets.concatenate, {"parts": [targets.Targets(row=1.0, range_mm=900.0)]}
    ),
    "yaml_file.read_yaml": Call(
        partial(yaml_file.read_yaml, error=CalibrationError), {"path": "a.yaml"}, PATH_ONLY
    ),
    "yaml_file.validate": Call(
        partial(yaml_file.validate, calibration.Calibration, error=CalibrationError),
        {"data": {}, "where": "a.yaml"},
        {"data": Kind([None, 3, "abc", [], {}, {3: 4}, {"name": 5}]), "where": Kind([])},
    ),
}

HOSTILE = [
    pytest.param(name, argument, id=f"{name}-{argument}")
    for name, call in CALLS.items()
    for argument in call.kinds
]


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def outcome(call: Call, argument: str, value: Any) -> tuple[Any, EschortyError | None]:
    """Result or typed error; anything else, warnings of numpy included, fails the test."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            return call.make(**{**call.good, argument: value}), None
        except EschortyError as error:
            return None, error
        except Exception as error:
            pytest.fail(f"{argument}={value!r:.60}: {type(error).__name__}: {error}")


@pytest.mark.parametrize(("name", "argument"), HOSTILE)
def test_case_26_refused_input_is_named(name, argument):
    call = CALLS[name]
    for value in call.kinds[argument].refused:
        _, error = outcome(call, argument, value)
        assert error is not None, f"{argument}={value!r:.60} was taken without a word"
        message = str(error)
        assert "\n" not in message
        assert len(message) < 400
        named = call.says.get(argument, argument)
        at_path = argument in ("path", "name_or_path", "data", "where")
        assert named in message or at_path, f"{argument}={value!r:.60}: {message}"


@pytest.mark.parametrize(("name", "argument"), HOSTILE)
def test_case_26_borderline_input_is_taken_or_named(name, argument):
    call = CALLS[name]
    for value in call.kinds[argument].borderline:
        _, error = outcome(call, argument, value)
        assert error is None or "\n" not in str(error)


@pytest.mark.parametrize(
    ("name", "argument"),
    [p for p in HOSTILE if CALLS[p.values[0]].kinds[p.values[1]].nan_gives_nan],
)
def test_case_26_nan_gives_nan_and_only_there(name, argument):
    call = CALLS[name]
    good = float(np.ravel(call.good[argument])[0])
    result, error = outcome(call, argument, np.array([np.nan, good]))
    assert error is None
    for values in [result] if isinstance(result, np.ndarray) else [result.row, result.swath_mm]:
        assert np.isnan(values).tolist() == [True, False]


@pytest.mark.parametrize("name", [n for n in CALLS if n not in ("recording.load_recording",)])
def test_case_26_good_input_is_taken(name):
    if name.startswith("yaml_file"):
        open("a.yaml", "w").close()
        pytest.skip("an empty file is a fault; its good files are those of the builds")
    CALLS[name].make(**CALLS[name].good)


def test_case_26_every_public_function_is_in_the_table():
    found = dict(public_callables())
    bare = {name for name, item in found.items() if not parameters(item)} & set(CALLS)
    known = set(CALLS) | HANDED_OUT | TESTED_ELSEWHERE
    assert set(found) - known == set(), "add these to CALLS"
    assert known - set(found) == set(), "these are gone"
    for name in set(CALLS) - bare:
        missing = parameters(found[name]) - set(CALLS[name].kinds) - PACKAGE_OBJECTS
        events = missing == {"events"} and name == "noise.ActivityFilter.filter"
        assert not missing or events, f"{name}: {missing} without a kind"
