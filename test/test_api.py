"""The public Python interface; its example is the package's docstring."""

from dataclasses import replace

import pytest

import eschorty_ros as es
from eschorty_ros.simulation.scenes import Plane
from eschorty_ros.simulation.world import simulate_recording


def test_settings_are_checked_and_an_empty_cloud_is_not_saved(tmp_path):
    narrow = replace(es.load_calibration("config_3"), columns=96, principal_column=47.5)
    simulate_recording(tmp_path, Plane(1300.0), narrow, stop_mm=12.0)
    with pytest.raises(es.EschortyError, match="no setting 'centre'"):
        es.reconstruct(tmp_path, centre="mean")
    (tmp_path / "cloud.ply").write_text("the last good one")
    empty = es.reconstruct(tmp_path, events_min=1000)
    with pytest.raises(es.EschortyError, match="0 points"):
        empty.save(tmp_path / "cloud.ply")
    assert (tmp_path / "cloud.ply").read_text() == "the last good one"
    assert "events_min" in empty.warnings[0]
