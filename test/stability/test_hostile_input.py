"""Hard case 26: whatever a caller hands to the core gives a valid result or one typed, named error.

The tables in ``test/hostile`` cover every public function, constructor and method of
``eschorty_ros.core``; the test at the end fails when one is missing. Arguments that are objects of
the package itself (a calibration, a modulation, a range model) are checked by the type checker,
not here.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
from hostile import calibrating, columns, posts, ranging, stored, streams, timing
from hostile.kinds import Call
from hostile.surface import parameters, public_callables

from eschorty_ros.core.base.errors import EschortyError

HANDED_OUT = {
    "calibrate.CalibrationReport", "calibrate.Rejected", "calibration_diagnostics.KProfile",
    "aggregate_frame.Pixels", "calibration_fit.CalibrationFit", "centroid.Centroids",
    "optical_build.Design", "optical_build.DesignTable", "evt3.Counters", "evt3.Events",
    "evt3.Triggers", "noise.FilterCounters", "offline.Result", "phase_estimate.PhaseEstimate",
    "edge_fit.EdgeFit", "post_finder.Post", "post_matching.PostMatch", "profiles.LineRows",
    "profiles.Profiles", "raw_file.Header", "recording.Recording", "yaml_file.Schema",
}  # fmt: skip
"""Plain records that the package makes; nobody else has to."""
TESTED_ELSEWHERE = {
    # All their arguments are objects of the package, or they take none.
    "offline.reconstruct_recording", "offline.stage_speed_mm_s", "warm_up.warm_up",
    "calibration.Calibration.model", "files.config_folders",
    # Their arguments go to moving_target and match_posts.
    "recorded_targets.recorded_moving_target", "recorded_targets.recorded_posts",
    # Every key of the file has its own test in test/core/optics/test_calibration_file.py.
    "calibration.Calibration",
}  # fmt: skip
PACKAGE_OBJECTS = {
    "arrivals", "calibration", "date", "design", "drain", "error", "frame", "grid", "held", "known",
    "last", "line", "model", "modulation", "nominal", "parts", "plan", "posts", "profiles",
    "progress", "schema", "now", "settings", "targets", "track",
}  # fmt: skip
TAKES_EVENTS = {"noise.ActivityFilter.filter", "aggregate_frame.AggregateFrame.add"}
"""Their tables give the arrays of the events one by one."""
NO_GOOD_EXAMPLE = {"recording.load_recording", "yaml_file.read_yaml", "yaml_file.validate"}
"""Their good files are read by the tests of recordings and calibrations."""
CALLS: dict[str, Call] = {
    **ranging.CALLS, **calibrating.CALLS, **posts.CALLS, **columns.CALLS, **timing.CALLS,
    **streams.CALLS, **stored.CALLS,
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


@pytest.mark.parametrize("name", [n for n in CALLS if n not in NO_GOOD_EXAMPLE])
def test_case_26_good_input_is_taken(name):
    CALLS[name].make(**CALLS[name].good)


def test_case_26_every_public_function_is_in_the_table():
    found = dict(public_callables())
    known = set(CALLS) | HANDED_OUT | TESTED_ELSEWHERE
    assert set(found) - known == set(), "add these to a table in test/hostile"
    assert known - set(found) == set(), "these are gone: take them out of test/hostile"
    for name in set(CALLS) - TAKES_EVENTS:
        missing = parameters(found[name]) - set(CALLS[name].kinds) - PACKAGE_OBJECTS
        assert not missing, f"{name}: say in test/hostile what {missing} may be"
