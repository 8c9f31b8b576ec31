"""Any input to the core's public API gives a valid result or one typed, named error.

The table covers what a user of the Python API calls; ``NOT_FOR_USERS`` lists the other names of
the packages. Arguments that are objects of the package itself (a calibration, a modulation, a
range model) are checked by the type checker, not here.
"""

import importlib
import inspect
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
SEEN = calibration.Targets([100.0, 300.0, 500.0], [860.0, 1064.0, 1395.0])
MOVE = clocks.plan_move(0, 0.0, 5.0, 1.0, 1.0)

# A valid value of each argument, and what else it may be.
SIDE = (64, integer(0, 2049))
BYTES = (b"\x00\x80", stream())
WHOLE = (3, integer())
POSITIVE = (1.0, number(0.0))
LENS = {
    "focal_length_mm": (24.0, number(0.0)),
    "f_number": (2.0, number(0.0)),
    "theta_deg": (85.87, number(0.0, 91.0)),
    "pixel_um": (4.86, number(0.0)),
    "b_mm": (0.0, number()),
    "columns": (1280, integer(0)),
    "rows": (720, integer(0)),
}
TARGET = {
    name: (100.0, vector(-1.0, np.inf, finite=False))
    for name in sorted(parameters(calibration.Targets))
}
SOME_FREE = Kind([3, "k", ["k_mm", "k_mm"], [], [3], [[]]])
PRIORS = Kind([{"k_mm": 1.0}, {"k_prime_px": 0.0}, {"k_prime_px": "a"}, 3, "k_mm"])


def call(make: Any, **arguments: tuple[Any, Kind]) -> Call:
    """Call with each argument's valid value and kind."""
    good = {name: value for name, (value, _) in arguments.items()}
    return Call(make, good, {name: kind for name, (_, kind) in arguments.items()})


def method(make: Any, name: str) -> Any:
    """Call ``name`` of a fresh object."""
    return lambda **arguments: getattr(make(), name)(**arguments)


def filtered(**events: Any) -> None:
    none = evt3.Triggers(TIMES[:0], SIGNS[:0], SIGNS[:0])
    evt3.ActivityFilter().filter(evt3.Events(**events, triggers=none))


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

    def make(**arguments: Any) -> Any:
        Path("t.csv").write_text(header)
        return read(**arguments)

    return make


def on_model(name: str, optional: str = "", **arguments: Any) -> Call:
    kinds = {argument: reals(optional=argument == optional) for argument in arguments}
    return Call(getattr(MODEL, name), arguments, kinds)


def setting(name: str) -> tuple[Any, Kind]:
    value = getattr(reconstruction.Settings(), name)
    if isinstance(value, str):
        return value, text()
    if name == "stage_speed_mm_s":
        return value, number(-10_000.1, 10_000.1)
    if isinstance(value, int):
        return value, integer(-2 if name == "phase_gate_us" else -1)
    return value, number(-1e-9)


CALLS: dict[str, Call] = {
    "evt3.Encoder": call(evt3.Encoder, width=SIDE, height=SIDE),
    "evt3.Encoder.encode": call(
        method(evt3.Encoder, "encode"),
        t=(TIMES, integers(-1, T_MAX, size=N)),
        x=(COLUMNS, integers(-1, 1280, 65535, size=N)),
        y=(COLUMNS, integers(-1, 720, 65535, size=N)),
        p=(SIGNS, integers(-1, 2, 255, size=N)),
        trigger_t=([1], integers(-1, T_MAX, size=1)),
        trigger_edge=([1], integers(-1, 2, size=1)),
        drop_t=([1], integers(-1, T_MAX)),
        rate_counts=(
            [[1, 2, 1]],
            Kind([[1, 2, 1], [[1, 2]], [[1.5, 2, 1]], [[-1, 2, 1]], [[1, 1 << 28, 1]], "abc"]),
        ),
    ),
    "evt3.Encoder.advance": call(method(evt3.Encoder, "advance"), t_us=(5, integer(-1, T_MAX))),
    "evt3.sort_readout": call(
        evt3.sort_readout,
        t=(TIMES, integers(-1, T_MAX, size=N)),
        x=(COLUMNS, integers(-1, 2048, size=N)),
        y=(COLUMNS, integers(-1, 2048, size=N)),
        p=(SIGNS, integers(-1, 2, 255, size=N)),
    ),
    "evt3.Decoder": call(evt3.Decoder, width=SIDE, height=SIDE),
    "evt3.Decoder.decode": call(method(evt3.Decoder, "decode"), data=BYTES),
    "evt3.begin_time": call(evt3.begin_time, data=BYTES),
    "evt3.first_time_high_us": call(evt3.first_time_high_us, data=BYTES),
    "evt3.time_span_us": call(evt3.time_span_us, data=BYTES),
    "evt3.ActivityFilter": call(
        evt3.ActivityFilter, width=SIDE, height=SIDE, window_us=(5, integer(0, 1_000_001))
    ),
    "evt3.ActivityFilter.filter": call(
        filtered,
        t=(TIMES, exactly("i8", N)),
        x=(COLUMNS, exactly("u2", N)),
        y=(COLUMNS, exactly("u2", N)),
        p=(SIGNS, exactly("u1", N)),
    ),
    "optics.Design.at": call(
        optics.design(
            theta_prime_deg=-7.6, b_prime_px=-1100.0, **{name: LENS[name][0] for name in LENS}
        ).at,
        range_mm=([900.0, 1300.0], reals()),
    ),
    "optics.design": call(
        optics.design,
        theta_prime_deg=(-7.6, number(0.0, 91.0)),
        baseline_mm=(None, Kind([3.0, "abc"])),
        b_prime_px=(-1100.0, number(0.0)),
        near_mm=(None, Kind([3.0, "abc"])),
        **LENS,
    ),
    "optics.laser_class": call(
        optics.laser_class,
        power_mw=(40.0, number(0.0)),
        wavelength_nm=(450.0, number(399.0, 1051.0)),
        fan_deg=(15.0, number(-1.0, 180.0)),
    ),
    "optics.design_for_ranges": call(
        optics.design_for_ranges,
        near_mm=(800.0, number(0.0, 2100.0)),
        far_mm=(2100.0, number(800.0)),
        **LENS,
    ),
    "optics.depth_of_field_mm": call(
        optics.depth_of_field_mm,
        magnification=([0.02], reals()),
        f_number=(2.0, number(0.0)),
        theta_deg=(85.0, number(0.0)),
        theta_prime_deg=(-7.0, number(-91.0, 91.0)),
        pixel_um=(5.0, number(0.0)),
    ),
    "optics.RangeModel": call(
        optics.RangeModel,
        k_mm=(24.0, number(0.0)),
        k_prime_px=(-37000.0, number(0.0, 37000.0)),
        b_mm=(0.0, number()),
        b_prime_px=(-1140.0, number(-0.5, 3.0)),
        pixel_um=(4.86, number(0.0)),
        columns=(1280, integer(0, -1)),
        rows=(720, integer(0)),
        principal_column=(639.5, number()),
        theta_deg=(85.87, number(0.0, 91.0)),
        b_prime_1_px=(0.0, number()),
        b_prime_2_px=(0.0, number()),
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
    "optics.config_file": call(optics.config_file, name=("config_3.yaml", path())),
    "optics.load_calibration": call(optics.load_calibration, name_or_path=("config_3", path())),
    "optics.save_calibration": call(
        partial(optics.save_calibration, CALIBRATION), path=("c.yaml", path())
    ),
    "optics.load_named_calibration": call(
        partial(optics.load_named_calibration, "."), name=("config_3", path())
    ),
    "optics.save_named_calibration": call(
        partial(optics.save_named_calibration, ".", CALIBRATION), name=("mine", path())
    ),
    "modulation.Modulation": call(
        modulation.Modulation,
        frequency_hz=(70.0, number(15.9, 20_001.0)),
        duty=(0.5, number(0.0, 1.0)),
        waveform=("square", text()),
        on_edge_us=(0, integer(T_MAX + 1, -T_MAX - 1, optional=True)),
    ),
    "modulation.Modulation.edge_us": call(LASER.edge_us, index=WHOLE),
    "clocks.StageTrack": call(clocks.StageTrack, max_gap_us=(5, integer(0, optional=True))),
    "clocks.StageTrack.append": call(
        method(clocks.StageTrack, "append"),
        t_us=(TIMES, integers(2**63, size=N)),
        position_mm=(np.zeros(N), vector(2e9, size=N)),
    ),
    "clocks.StageTrack.position_mm": call(
        method(a_track, "position_mm"), t_us=([3, 4], integers(2**63, size=2, any_shape=True))
    ),
    "clocks.SensorClock": call(
        clocks.SensorClock, zero_ns=(5, integer(optional=True)), window_ns=(10, integer(0))
    ),
    "clocks.SensorClock.observe": call(
        method(clocks.SensorClock, "observe"), t_us=WHOLE, arrival_ns=WHOLE
    ),
    "clocks.SensorClock.to_ns": call(method(partial(clocks.SensorClock, 7), "to_ns"), t_us=WHOLE),
    "clocks.SensorClock.to_us": call(method(partial(clocks.SensorClock, 7), "to_us"), t_ns=WHOLE),
    "clocks.plan_move": call(
        clocks.plan_move,
        start_ns=WHOLE,
        position_mm=(0.0, number()),
        target_mm=(5.0, number()),
        speed_mm_s=POSITIVE,
        acceleration_mm_s2=POSITIVE,
    ),
    "clocks.MotionPlan.state": call(
        MOVE.state, t_ns=([3, 4], integers(2**63, size=2, any_shape=True))
    ),
    "line.estimate": call(
        lambda centroid, **others: line.estimate(method=centroid, **others),
        rows=(COLUMNS, integers(-1, 720, 65535, 2**40, size=N)),
        offsets=([0, 1, N], integers(-1, 5, 2**40, size=2)),
        centroid=("mode_mean", text()),
        returns=("last", text()),
        line_width_px=(20.0, number(0.0, 721.0)),
        height=(720, integer(0, 5000)),
        sigma_factor=(0.24, number(-1.0)),
    ),
    "line.relative_reflectance": call(
        line.relative_reflectance,
        edge_us=(np.zeros(N, np.int64), integers(2**63, size=N)),
        width_px=(np.ones(N), vector(-1.0, size=N)),
        events=(np.ones(N, np.uint32), integers(-1, size=N)),
        footprint_sigma_px=(4.0, number(0.0)),
        white_width_px=(0.0, number(-1.0)),
    ),
    "reconstruction.Settings": call(
        reconstruction.Settings,
        **{name: setting(name) for name in sorted(parameters(reconstruction.Settings))},
    ),
    "reconstruction.Reconstructor.push": call(
        method(partial(reconstruction.Reconstructor, CALIBRATION, LASER), "push"), data=BYTES
    ),
    "reconstruction.Profiles.select": call(
        blank_profiles(N).select,
        mask=([0, 1], Kind(["abc", [0.5], [float("nan")], [N], [-N - 1], [True], [HUGE]])),
    ),
    "reconstruction.place_link": call(
        partial(reconstruction.place_link, blank_profiles(N), MODEL), origin_us=(0, integer(2**63))
    ),
    "reconstruction.live_points": call(
        reconstruction.live_points,
        points=(POINTS, Kind(["abc", None, np.zeros(N)])),
        t_ns=(np.zeros(N, np.int64), Kind(["abc", None, np.zeros(N), np.zeros(N - 1, np.int64)])),
        stamp_ns=(0, integer(2**63)),
    ),
    "reconstruction.place": call(
        partial(reconstruction.place, model=MODEL),
        profiles=(blank_profiles(N), Kind([None, 3, "abc", np.zeros(N)])),
        stage_position_mm=(
            np.zeros(N),
            Kind(["abc", None, np.zeros(N + 1), np.zeros((2, 2))], [np.nan]),
        ),
        stage_direction=((0.0, 1.0, 0.0), vector(0.0, 1.0, 2.0, size=3)),
        origin_us=(0, integer(2**63)),
    ),
    "storage.RawReader": call(
        lambda path: (raw_writer(), raw_file.RawReader(path)), path=("events.raw", path())
    ),
    "storage.RawReader.chunks": call(raw_chunks, size=(5, integer(0))),
    "storage.RawWriter": call(
        raw_writer,
        path=("events.raw", path()),
        width=SIDE,
        height=SIDE,
    ),
    "storage.RawWriter.write": call(raw_write, data=(b"abc", stream())),
    "storage.write_cloud": call(
        storage.write_cloud,
        path=("c.pcd", path()),
        points=(POINTS, Kind([None, 3, "abc", np.zeros(3), POINTS.reshape(2, 2, 1)])),
    ),
    "storage.read_cloud": call(
        lambda path: (storage.write_cloud("c.pcd", POINTS), storage.read_cloud(path)),
        path=("c.pcd", path()),
    ),
    "storage.join_points": call(
        storage.join_points,
        parts=([POINTS, POINTS], Kind([[], None, 3, [3], [np.zeros(3)], "abc", [POINTS, None]])),
    ),
    "storage.load_recording": Call(storage.load_recording, {}, {"path": path()}),
    "storage.read_laser_yaml": call(
        lambda path: (storage.write_laser_yaml("laser.yaml", LASER), storage.read_laser_yaml(path)),
        path=("laser.yaml", path()),
    ),
    "storage.read_stage_csv": Call(storage.read_stage_csv, {}, {"path": path()}),
    "storage.read_truth_csv": Call(storage.read_truth_csv, {}, {"path": path()}),
    "storage.write_laser_yaml": call(
        partial(storage.write_laser_yaml, modulation=LASER), path=("laser.yaml", path())
    ),
    "storage.write_stage_csv": call(
        storage.write_stage_csv,
        path=("stage.csv", path()),
        t_us=(TIMES, integers(2**63, size=N)),
        position_mm=(np.zeros(N), vector(2e9, size=N)),
    ),
    "storage.write_truth_csv": call(
        storage.write_truth_csv,
        path=("truth.csv", path()),
        t_us=(TIMES, integers(2**63, size=N)),
        column=(COLUMNS, integers(-1, 65536, size=N)),
        range_mm=(np.zeros(N), vector(2e9, size=N)),
    ),
    "calibration.Targets": call(
        calibration.Targets,
        **TARGET
        | {
            "row": (100.0, vector()),
            "column": (100.0, vector(np.inf, finite=False)),
            "labels": (["a"], Kind([[3], ["a", "b"], 3])),
        },
    ),
    "calibration.KnownTarget": call(
        calibration.KnownTarget,
        range_mm=(900.0, number(0.0)),
        sigma_range_mm=(0.0, number(-1.0)),
        size_mm=(25.4, number_or_nan(0.0, -1.0)),
        column=(3.0, number_or_nan()),
        row=(3.0, number_or_nan()),
        label=("a", Kind([3, None, float("nan")])),
    ),
    "calibration.calibrate": call(
        partial(calibration.calibrate, SEEN, CALIBRATION),
        method=("joint", text()),
        free=(("k_prime_px", "b_prime_px"), SOME_FREE),
        prior_sigma=(None, PRIORS),
        robust=(None, Kind([True])),
    ),
    "calibration.CalibrationReport.range_sigma_mm": call(
        calibration.calibrate(SEEN, CALIBRATION).range_sigma_mm,
        row=([100.0], reals()),
        sigma_row=([0.3], reals()),
        column=([639.5], reals(optional=True)),
    ),
    "calibration.fit": call(
        partial(calibration.fit, SEEN, MODEL),
        free=(("k_prime_px",), Kind([None, *SOME_FREE.refused])),
        prior_sigma=(None, PRIORS),
    ),
    "calibration.write_targets": call(
        lambda path: calibration.write_targets(path, SEEN), path=("t.csv", path())
    ),
    "calibration.read_targets": call(
        reading(calibration.read_targets, "row,range_mm\n100,900\n"),
        path=("t.csv", path()),
        sigma_row_px=(0.3, number(0.0)),
        sigma_range_mm=(1.0, number(-1.0)),
    ),
    "calibration.read_distances": call(
        reading(calibration.read_distances, "range_mm\n900\n"),
        path=("t.csv", path()),
        sigma_range_mm=(1.0, number(-1.0)),
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
        assert len(message) <= 300
        at_path = argument in ("path", "name_or_path", "data")
        assert argument in message or at_path, f"{argument}={value!r:.60}: {message}"
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
    "calibration.CalibrationFit", "calibration.Post", "evt3.BeginTime", "evt3.Counters",
    "evt3.EventArrays",
    "evt3.Events", "evt3.Triggers", "line.Centroids", "optics.DesignTable",
    "optics.LaserClass", "reconstruction.Result", "reconstruction.SensorWindow",
    "storage.Recording", "storage.ScanLog",
    # Their arguments are objects of the package, or go to functions of the table.
    "calibration.AggregateFrame", "calibration.find_posts", "calibration.match_posts",
    "calibration.moving_target", "calibration.recorded_moving_target",
    "calibration.recorded_posts", "optics.photons_per_column", "optics.refuse_other_instrument",
    "optics.refuse_other_sensor", "reconstruction.add_stage",
    "reconstruction.reconstruct_recording", "reconstruction.recorded_settings",
    "reconstruction.region_window",
    "storage.finite_points", "storage.height_map", "storage.is_cloud",
    "reconstruction.PassLag", "reconstruction.pass_lag", "reconstruction.take_off_lag",
    "reconstruction.cause_of_few", "reconstruction.without_modulation",
    "reconstruction.stage_offset_m", "reconstruction.stage_speed_mm_s", "reconstruction.warm_up",
    # Parts of the streaming pipeline.
    "clocks.ClockLine", "clocks.EdgeClock", "clocks.LowerEnvelope", "clocks.MotionFit",
    "clocks.MotionPlan", "clocks.PulseTrain", "clocks.fit_edges", "clocks.leading_edges",
    "clocks.plan_stop", "clocks.quantise_nm", "line.check_method", "line.events_per_row",
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
