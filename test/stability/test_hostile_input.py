"""Any input to the core's public API gives a valid result or one typed, named error.

The table covers what a user of the Python API calls; ``NOT_FOR_USERS`` lists the other names of
the packages. Arguments that are objects of the package itself (a calibration, a modulation, a
range model) are checked by the type checker, not here.
"""

from __future__ import annotations

import importlib
import inspect
import warnings
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile import (
    HUGE,
    Call,
    Kind,
    exactly,
    integer,
    integers,
    number,
    number_or_nan,
    parameters,
    path,
    reals,
    stream,
    text,
    vector,
)
from line_events import blank_profiles

from eschorty_ros.core import (
    calibration,
    clocks,
    evt3,
    line,
    modulation,
    optics,
    reconstruction,
    storage,
)
from eschorty_ros.core.base.errors import EschortyError
from eschorty_ros.core.storage import raw_file

CALIBRATION = optics.load_calibration("config_3")
MODEL = CALIBRATION.model()
LASER = modulation.Modulation(70.0, on_edge_us=0)
T_MAX = 1 << 62
N = 4
TIMES = np.arange(N, dtype=np.int64)
COLUMNS = np.arange(N, dtype=np.uint16)
SIGNS = np.ones(N, np.uint8)
POINTS = np.zeros(N, storage.POINT_DTYPE)
EVENTS = {"t": TIMES, "x": COLUMNS, "y": COLUMNS, "p": SIGNS}
SIZE = {"width": integer(0, 2049), "height": integer(0, 2049)}
PATH = {"path": path()}
LENS = {"focal_length_mm": 24.0, "f_number": 2.0, "theta_deg": 85.87, "pixel_um": 4.86, "b_mm": 0.0}
LENS_KINDS = {
    "focal_length_mm": number(0.0), "f_number": number(0.0), "theta_deg": number(0.0, 91.0),
    "pixel_um": number(0.0), "b_mm": number(), "columns": integer(0), "rows": integer(0),
}  # fmt: skip
PIXELS = {"columns": 1280, "rows": 720}
SEEN = calibration.Targets([100.0, 300.0, 500.0], [860.0, 1064.0, 1395.0])
TARGET = dict.fromkeys(sorted(parameters(calibration.Targets) - {"labels"}), 100.0)
SOME_FREE = Kind([3, "k", ["k_mm", "k_mm"], [], [3], [[]]])
FREE = Kind([None, *SOME_FREE.refused])
PRIORS = Kind([{"k_mm": 1.0}, {"k_prime_px": 0.0}, {"k_prime_px": "a"}, 3, "k_mm"])
MOVE = clocks.plan_move(0, 0.0, 5.0, 1.0, 1.0)


def method(make: Any, name: str) -> Any:
    """Call ``name`` of a fresh object."""
    return lambda **arguments: getattr(make(), name)(**arguments)


def events_with(**changed: Any) -> evt3.Events:
    none = evt3.Triggers(TIMES[:0], SIGNS[:0], SIGNS[:0])
    return evt3.Events(**{**EVENTS, **changed}, triggers=none)


def raw_writer(path: Any = "events.raw", **arguments: Any) -> None:
    raw_file.RawWriter(path, **arguments).close()


def raw_write(data: Any) -> None:
    with raw_file.RawWriter("events.raw") as writer:
        writer.write(data)


def raw_chunks(size: Any) -> bytes:
    raw_writer()
    return b"".join(raw_file.RawReader("events.raw").chunks(size))


def a_track() -> clocks.StageTrack:
    track = clocks.StageTrack()
    track.append([0, 10], [0.0, 1.0])
    return track


def reading(read: Any, header: str) -> Any:
    """Read a small file of its own, or the path given."""

    def call(**arguments: Any) -> Any:
        Path("t.csv").write_text(header)
        return read(**arguments)

    return call


def on_model(name: str, optional: str = "", **arguments: Any) -> Call:
    kinds = {argument: reals(optional=argument == optional) for argument in arguments}
    return Call(getattr(MODEL, name), arguments, kinds)


def blank_settings() -> dict[str, Any]:
    blank = reconstruction.Settings()
    return {name: getattr(blank, name) for name in sorted(parameters(reconstruction.Settings))}


def settings_kind(name: str, value: Any) -> Kind:
    if isinstance(value, str):
        return text()
    if name == "stage_speed_mm_s":
        return number(-10_000.1, 10_000.1)
    return integer(-1) if isinstance(value, int) else number(-1e-9)


EVT3 = {
    "evt3.Encoder": Call(evt3.Encoder, {"width": 64, "height": 64}, SIZE),
    "evt3.Encoder.encode": Call(
        method(evt3.Encoder, "encode"),
        dict(EVENTS, trigger_t=[1], trigger_edge=[1], drop_t=[1], rate_counts=[[1, 2, 1]]),
        {
            "t": integers(-1, T_MAX, size=N),
            "x": integers(-1, 1280, 65535, size=N),
            "y": integers(-1, 720, 65535, size=N),
            "p": integers(-1, 2, 255, size=N),
            "trigger_t": integers(-1, T_MAX, size=1),
            "trigger_edge": integers(-1, 2, size=1),
            "drop_t": Kind([bad for bad in integers(-1, T_MAX).refused if bad is not None]),
            "rate_counts": Kind(
                [[1, 2, 1], [[1, 2]], [[1.5, 2, 1]], [[-1, 2, 1]], [[1, 1 << 28, 1]], "abc"]
            ),
        },
    ),
    "evt3.Encoder.advance": Call(
        method(evt3.Encoder, "advance"), {"t_us": 5}, {"t_us": integer(-1, T_MAX)}
    ),
    "evt3.sort_readout": Call(
        evt3.sort_readout,
        EVENTS,
        {
            "t": integers(-1, T_MAX, size=N),
            "x": integers(-1, 2048, size=N),
            "y": integers(-1, 2048, size=N),
            "p": integers(-1, 2, 255, size=N),
        },
    ),
    "evt3.Decoder": Call(evt3.Decoder, {"width": 64, "height": 64}, SIZE),
    "evt3.Decoder.decode": Call(
        method(evt3.Decoder, "decode"), {"data": b"\x00\x80"}, {"data": stream()}
    ),
    "evt3.WordCounter.add": Call(
        method(evt3.WordCounter, "add"), {"data": b"\x00\x80"}, {"data": stream()}
    ),
    "evt3.ActivityFilter": Call(
        evt3.ActivityFilter,
        {"width": 64, "height": 64, "window_us": 5},
        dict(SIZE, window_us=integer(0, 1_000_001)),
    ),
    "evt3.ActivityFilter.filter": Call(
        lambda **changed: evt3.ActivityFilter().filter(events_with(**changed)),
        EVENTS,
        {
            "t": exactly("i8", N),
            "x": exactly("u2", N),
            "y": exactly("u2", N),
            "p": exactly("u1", N),
        },
    ),
}
OPTICS = {
    "optics.Design.at": Call(
        optics.design(theta_prime_deg=-7.6, b_prime_px=-1100.0, **LENS).at,
        {"range_mm": [900.0, 1300.0]},
        {"range_mm": reals()},
    ),
    "optics.design": Call(
        optics.design,
        dict(
            LENS, **PIXELS, theta_prime_deg=-7.6, baseline_mm=None, b_prime_px=-1100.0, near_mm=None
        ),
        dict(
            LENS_KINDS,
            theta_prime_deg=number(0.0, 91.0),
            baseline_mm=Kind([3.0, "abc"]),
            b_prime_px=number(0.0),
            near_mm=Kind([3.0, "abc"]),
        ),
    ),
    "optics.design_for_ranges": Call(
        optics.design_for_ranges,
        dict(LENS, **PIXELS, near_mm=800.0, far_mm=2100.0),
        dict(LENS_KINDS, near_mm=number(0.0, 2100.0), far_mm=number(800.0)),
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
            "b_prime_1_px": 0.0,
            "b_prime_2_px": 0.0,
        },
        {
            "k_mm": number(0.0),
            "k_prime_px": number(0.0),
            "b_mm": number(),
            "b_prime_px": number(-0.5),
            "pixel_um": number(0.0),
            "columns": integer(0),
            "rows": integer(0),
            "principal_column": number(),
            "theta_deg": number(0.0, 91.0),
            "b_prime_1_px": number(),
            "b_prime_2_px": number(),
        },
    ),
    "optics.RangeModel.range_mm": on_model("range_mm", "column", row=[3.0], column=[639.5]),
    "optics.RangeModel.row": on_model("row", "column", range_mm=[1300.0], column=[639.5]),
    "optics.RangeModel.magnification": on_model("magnification", row=[3.0]),
    "optics.RangeModel.range_per_row_mm": on_model("range_per_row_mm", range_mm=[1300.0]),
    "optics.RangeModel.range_sigma_mm": on_model(
        "range_sigma_mm", "column", row=[3.0], sigma_row=[0.3], column=[639.5]
    ),
    "optics.RangeModel.column_slope": on_model("column_slope", column=[3.0]),
    "optics.RangeModel.lateral_mm": on_model("lateral_mm", column=[3.0], range_mm=[1300.0]),
    "optics.config_file": Call(optics.config_file, {"name": "config_3.yaml"}, {"name": path()}),
    "optics.load_calibration": Call(
        optics.load_calibration, {"name_or_path": "config_3"}, {"name_or_path": path()}
    ),
    "optics.save_calibration": Call(
        partial(optics.save_calibration, CALIBRATION), {"path": "c.yaml"}, PATH
    ),
}
MODULATION = {
    "modulation.Modulation": Call(
        modulation.Modulation,
        {"frequency_hz": 70.0, "duty": 0.5, "waveform": "square", "on_edge_us": 0},
        {
            "frequency_hz": number(15.9, 20_001.0),
            "duty": number(0.0, 1.0),
            "waveform": text(),
            "on_edge_us": integer(T_MAX + 1, -T_MAX - 1, optional=True),
        },
    ),
    "modulation.Modulation.edge_us": Call(LASER.edge_us, {"index": 3}, {"index": integer()}),
}
CLOCKS = {
    "clocks.StageTrack": Call(
        clocks.StageTrack, {"max_gap_us": 5}, {"max_gap_us": integer(0, optional=True)}
    ),
    "clocks.StageTrack.append": Call(
        method(clocks.StageTrack, "append"),
        {"t_us": TIMES, "position_mm": np.zeros(N)},
        {"t_us": integers(2**63, size=N), "position_mm": vector(2e9, size=N)},
    ),
    "clocks.StageTrack.position_mm": Call(
        method(a_track, "position_mm"),
        {"t_us": [3, 4]},
        {"t_us": integers(2**63, size=2, any_shape=True)},
    ),
    "clocks.SensorClock": Call(
        clocks.SensorClock,
        {"zero_ns": 5, "window_ns": 10},
        {"zero_ns": integer(optional=True), "window_ns": integer(0)},
    ),
    "clocks.SensorClock.observe": Call(
        method(clocks.SensorClock, "observe"),
        {"t_us": 5, "arrival_ns": 10},
        {"t_us": integer(), "arrival_ns": integer()},
    ),
    "clocks.SensorClock.to_ns": Call(
        method(partial(clocks.SensorClock, 7), "to_ns"), {"t_us": 3}, {"t_us": integer()}
    ),
    "clocks.SensorClock.to_us": Call(
        method(partial(clocks.SensorClock, 7), "to_us"), {"t_ns": 3}, {"t_ns": integer()}
    ),
    "clocks.plan_move": Call(
        clocks.plan_move,
        {
            "start_ns": 0,
            "position_mm": 0.0,
            "target_mm": 5.0,
            "speed_mm_s": 1.0,
            "acceleration_mm_s2": 1.0,
        },
        {
            "start_ns": integer(),
            "position_mm": number(),
            "target_mm": number(),
            "speed_mm_s": number(0.0),
            "acceleration_mm_s2": number(0.0),
        },
    ),
    "clocks.MotionPlan.state": Call(
        MOVE.state, {"t_ns": [3, 4]}, {"t_ns": integers(2**63, size=2, any_shape=True)}
    ),
}
LINE = {
    "line.estimate": Call(
        line.estimate,
        {
            "rows": COLUMNS,
            "offsets": [0, 1, N],
            "method": "mode_mean",
            "returns": "last",
            "line_width_px": 20.0,
            "height": 720,
            "events_min": 1,
            "sigma_factor": 0.24,
            "sigma_floor_px": 0.2,
            "sigma_common_px": 0.1,
        },
        {
            "rows": integers(-1, 720, 65535, 2**40, size=N),
            "offsets": integers(-1, 5, 2**40, size=2),
            "method": text(),
            "returns": text(),
            "line_width_px": number(0.0, 721.0),
            "height": integer(0, 5000),
            "events_min": integer(0),
            "sigma_factor": number(-1.0),
            "sigma_floor_px": number(-1.0),
            "sigma_common_px": number(-1.0),
        },
        {"method": "centroid"},
    ),
    "line.relative_reflectance": Call(
        line.relative_reflectance,
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
}
RECONSTRUCTION = {
    "reconstruction.Settings": Call(
        reconstruction.Settings,
        blank_settings(),
        {name: settings_kind(name, value) for name, value in blank_settings().items()},
    ),
    "reconstruction.Reconstructor.push": Call(
        method(partial(reconstruction.Reconstructor, CALIBRATION, LASER), "push"),
        {"data": b"\x00\x80"},
        {"data": stream()},
    ),
    "reconstruction.Profiles.select": Call(
        blank_profiles(N).select,
        {"mask": [0, 1]},
        {"mask": Kind(["abc", [0.5], [float("nan")], [N], [-N - 1], [True], [HUGE]])},
    ),
    "reconstruction.place_link": Call(
        partial(reconstruction.place_link, blank_profiles(N), MODEL),
        {"origin_us": 0},
        {"origin_us": integer(2**63)},
    ),
    "reconstruction.place": Call(
        partial(reconstruction.place, blank_profiles(N), MODEL),
        {
            "stage_position_mm": np.zeros(N),
            "stage_direction": (0.0, 1.0, 0.0),
            "origin_us": 0,
        },
        {
            "stage_position_mm": Kind(["abc", None, np.zeros(N + 1), np.zeros((2, 2))], [np.nan]),
            "stage_direction": vector(0.0, 1.0, size=3),
            "origin_us": integer(2**63),
        },
    ),
}
STORAGE = {
    "storage.RawReader": Call(
        lambda path: (raw_writer(), raw_file.RawReader(path)), {"path": "events.raw"}, PATH
    ),
    "storage.RawReader.chunks": Call(raw_chunks, {"size": 5}, {"size": integer(0)}),
    "storage.RawWriter": Call(
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
    "storage.RawWriter.write": Call(raw_write, {"data": b"abc"}, {"data": stream()}),
    "storage.write_cloud": Call(
        storage.write_cloud,
        {"path": "c.pcd", "points": POINTS},
        {"path": path(), "points": Kind([None, 3, "abc", np.zeros(3), POINTS.reshape(2, 2)])},
    ),
    "storage.read_cloud": Call(
        lambda path: (storage.write_cloud("c.pcd", POINTS), storage.read_cloud(path)),
        {"path": "c.pcd"},
        PATH,
    ),
    "storage.join_points": Call(
        storage.join_points,
        {"parts": [POINTS, POINTS]},
        {"parts": Kind([[], None, 3, [3], [np.zeros(3)], "abc", [POINTS, None]])},
    ),
    "storage.load_recording": Call(storage.load_recording, {}, PATH),
    "storage.read_laser_yaml": Call(
        lambda path: (
            storage.write_laser_yaml("laser.yaml", LASER),
            storage.read_laser_yaml(path),
        ),
        {"path": "laser.yaml"},
        PATH,
    ),
    "storage.write_laser_yaml": Call(
        partial(storage.write_laser_yaml, modulation=LASER), {"path": "laser.yaml"}, PATH
    ),
    "storage.write_stage_csv": Call(
        storage.write_stage_csv,
        {"path": "stage.csv", "t_us": TIMES, "position_mm": np.zeros(N)},
        {"path": path(), "t_us": integers(2**63, size=N), "position_mm": vector(2e9, size=N)},
    ),
    "storage.write_truth_csv": Call(
        storage.write_truth_csv,
        {"path": "truth.csv", "t_us": TIMES, "column": COLUMNS, "range_mm": np.zeros(N)},
        {
            "path": path(),
            "t_us": integers(2**63, size=N),
            "column": integers(-1, 65536, size=N),
            "range_mm": vector(2e9, size=N),
        },
    ),
}
CALIBRATING = {
    "calibration.Targets": Call(
        calibration.Targets,
        dict(TARGET, labels=["a"]),
        dict(
            dict.fromkeys(TARGET, vector(-1.0, np.inf, finite=False)),
            row=vector(),
            column=vector(np.inf, finite=False),
            labels=Kind([[3], ["a", "b"], 3]),
        ),
    ),
    "calibration.KnownTarget": Call(
        calibration.KnownTarget,
        {
            "range_mm": 900.0,
            "sigma_range_mm": 0.0,
            "size_mm": 25.4,
            "column": 3.0,
            "row": 3.0,
            "label": "a",
        },
        {
            "range_mm": number(0.0),
            "sigma_range_mm": number(-1.0),
            "size_mm": number_or_nan(0.0, -1.0),
            "column": number_or_nan(),
            "row": number_or_nan(),
            "label": Kind([3, None, float("nan")]),
        },
    ),
    "calibration.calibrate": Call(
        partial(calibration.calibrate, SEEN, CALIBRATION),
        {"method": "joint", "free": ("k_prime_px", "b_prime_px"), "prior_sigma": None},
        {"method": text(), "free": SOME_FREE, "prior_sigma": PRIORS, "robust": Kind([True])},
    ),
    "calibration.CalibrationReport.range_sigma_mm": Call(
        calibration.calibrate(SEEN, CALIBRATION).range_sigma_mm,
        {"row": [100.0], "sigma_row": [0.3], "column": [639.5]},
        {"row": reals(), "sigma_row": reals(), "column": reals(optional=True)},
    ),
    "calibration.fit": Call(
        partial(calibration.fit, SEEN, MODEL),
        {"free": ("k_prime_px",), "prior_sigma": None},
        {"free": FREE, "prior_sigma": PRIORS},
    ),
    "calibration.write_targets": Call(
        lambda path: calibration.write_targets(path, SEEN), {"path": "t.csv"}, PATH
    ),
    "calibration.read_targets": Call(
        reading(calibration.read_targets, "row,range_mm\n100,900\n"),
        {"path": "t.csv", "sigma_row_px": 0.3, "sigma_range_mm": 1.0},
        {"path": path(), "sigma_row_px": number(0.0), "sigma_range_mm": number(-1.0)},
    ),
    "calibration.read_distances": Call(
        reading(calibration.read_distances, "range_mm\n900\n"),
        {"path": "t.csv", "sigma_range_mm": 1.0},
        {"path": path(), "sigma_range_mm": number(-1.0)},
    ),
}
CALLS: dict[str, Call] = {
    **EVT3, **OPTICS, **MODULATION, **CLOCKS, **LINE, **RECONSTRUCTION, **STORAGE, **CALIBRATING,
}  # fmt: skip
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
@pytest.mark.hard_case(26)
def test_bad_input_is_refused_and_named(name, argument):
    call = CALLS[name]
    for value in call.kinds[argument].refused:
        _, error = outcome(call, argument, value)
        assert error is not None, f"{argument}={value!r:.60} was accepted"
        message = str(error)
        assert "\n" not in message
        assert len(message) < 400
        at_path = argument in ("path", "name_or_path", "data")
        named = call.named.get(argument, argument) in message
        assert named or at_path, f"{argument}={value!r:.60}: {message}"
    for value in call.kinds[argument].borderline:
        _, error = outcome(call, argument, value)
        assert error is None or "\n" not in str(error)


@pytest.mark.parametrize(
    ("name", "argument"),
    [p for p in HOSTILE if CALLS[p.values[0]].kinds[p.values[1]].nan_gives_nan],
)
@pytest.mark.hard_case(26)
def test_nan_gives_nan_and_only_there(name, argument):
    call = CALLS[name]
    good = float(np.ravel(call.good[argument])[0])
    result, error = outcome(call, argument, np.array([np.nan, good]))
    assert error is None
    for values in [result] if isinstance(result, np.ndarray) else [result.row, result.swath_mm]:
        assert np.isnan(values).tolist() == [True, False]


@pytest.mark.parametrize("name", [name for name, call in CALLS.items() if call.good])
@pytest.mark.hard_case(26)
def test_good_input_is_accepted(name):
    CALLS[name].make(**CALLS[name].good)


NOT_FOR_USERS = {
    # Plain records that the package makes.
    "calibration.CalibrationFit", "calibration.Post", "evt3.Counters", "evt3.EventArrays",
    "evt3.Events", "evt3.Triggers", "line.Centroids", "optics.DesignTable",
    "reconstruction.Result", "storage.Recording",
    # Their arguments are objects of the package, or go to functions of the table.
    "calibration.AggregateFrame", "calibration.find_posts", "calibration.match_posts",
    "calibration.moving_target", "calibration.recorded_moving_target",
    "calibration.recorded_posts", "optics.refuse_other_instrument",
    "reconstruction.add_stage", "reconstruction.reconstruct_recording",
    "reconstruction.stage_offset_m", "reconstruction.stage_speed_mm_s", "reconstruction.warm_up",
    # Parts of the streaming pipeline.
    "clocks.ClockLine", "clocks.EdgeClock", "clocks.LowerEnvelope", "clocks.MotionPlan",
    "clocks.PulseTrain", "clocks.fit_edges", "clocks.leading_edges", "clocks.plan_stop",
    "clocks.quantise_nm", "line.check_method", "line.events_per_row",
    # Every key of the file has its own test in test/core/optics.
    "optics.Calibration",
}  # fmt: skip


@pytest.mark.hard_case(26)
def test_every_public_name_is_in_the_table():
    packages = {name.split(".")[0] for name in CALLS}
    public = {
        f"{package}.{name}"
        for package in packages
        for name, item in vars(importlib.import_module(f"eschorty_ros.core.{package}")).items()
        if not name.startswith("_") and (inspect.isclass(item) or inspect.isfunction(item))
    }
    known = {".".join(name.split(".")[:2]) for name in CALLS} | NOT_FOR_USERS
    assert public - known == set(), "add these to the table"
    assert not NOT_FOR_USERS - public, "take out what is gone"
