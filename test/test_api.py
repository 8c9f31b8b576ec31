"""The public Python interface; its example is the package's docstring."""

from dataclasses import replace

import numpy as np
import pytest

import eschorty_ros as es
from eschorty_ros.core.evt3 import Decoder
from eschorty_ros.simulation.scenes import Plane
from eschorty_ros.simulation.world import simulate_recording


def test_settings_are_checked_and_an_empty_cloud_is_not_saved(tmp_path):
    narrow = replace(es.load_calibration("config_3"), columns=96, principal_column=None)
    simulate_recording(tmp_path, Plane(1300.0), narrow, stop_mm=12.0)
    with pytest.raises(es.EschortyError, match="no setting 'centre'"):
        es.reconstruct(tmp_path, centre="mean")
    with pytest.raises(TypeError, match="1 positional argument"):
        es.reconstruct(tmp_path, es.Settings())
    (tmp_path / "cloud.ply").write_text("the last good one")
    empty = es.reconstruct(tmp_path, events_min=1000)
    with pytest.raises(es.EschortyError, match="0 points"):
        empty.save(tmp_path / "cloud.ply")
    assert (tmp_path / "cloud.ply").read_text() == "the last good one"
    assert "events_min" in empty.warnings[0]
    other = es.reconstruct(tmp_path, calibration=replace(narrow, b_mm=narrow.b_mm + 5.0))
    plain = es.reconstruct(tmp_path)
    assert np.median(plain.points["x"] - other.points["x"]) == pytest.approx(5e-3, abs=1e-6)
    assert "given as 71 Hz" in es.reconstruct(tmp_path, frequency_hz=71.0).warnings[0]


def test_events_of_another_camera_in_any_order_give_the_same_points(tmp_path):
    print("seed 5")
    other = replace(es.load_calibration("config_3"), columns=96, principal_column=None)
    recording = simulate_recording(tmp_path, Plane(1300.0), other, stop_mm=12.0)
    points = es.reconstruct(tmp_path).points
    events = Decoder(96, 720).decode(b"".join(es.RawReader(recording.events_path)))
    order = np.random.default_rng(5).permutation(events.t.size)
    arrays = (values[order] for values in (events.t, events.x, events.y, events.p > 0))
    es.write_events_raw(recording.events_path, *arrays, columns=96, rows=720)
    again = es.reconstruct(tmp_path).points
    assert points.size > 1000
    np.testing.assert_array_equal(again, points)


def test_settings_may_be_numpys_numbers_and_a_wrong_type_is_one_line():
    settings = es.Settings(events_min=np.int64(5), line_width_px=np.float32(20.0), range_max=2)
    assert settings == es.Settings(events_min=5, line_width_px=20.0, range_max=2.0)
    assert (type(settings.events_min), type(settings.range_max)) == (int, float)
    for value in (np.bool_(True), np.float64(5.0), "5"):
        with pytest.raises(es.EschortyError, match=r"events_min is .*; choose a whole number"):
            es.Settings(events_min=value)
    build, modulation = es.load_calibration("config_3"), es.Modulation(70.0)
    for arguments, text in (
        (("config_3", modulation), "calibration is 'config_3'; give a Calibration"),
        ((build, 70.0), "modulation is 70.0; give a Modulation"),
        ((build, modulation, {"events_min": 5}), "settings is .*; give a Settings"),
    ):
        with pytest.raises(es.EschortyError, match=text):
            es.Reconstructor(*arguments)
