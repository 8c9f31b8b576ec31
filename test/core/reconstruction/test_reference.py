"""The plain reference agrees with the streaming `mean`, and shows why it is not the default."""

from __future__ import annotations

import numpy as np
import pytest
from line_events import encoded, line_events

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.evt3 import Decoder, Encoder
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.core.reconstruction import Profiles, Reconstructor, Settings
from eschorty_ros.core.reconstruction import paper_method as reference

SEED = 8
CALIBRATION = load_calibration("config_3")
MODULATION = Modulation(70.0, on_edge_us=1000)


def flat(k, c):
    return np.full(c.shape, 350.0)


def test_numpy_decodes_what_the_decoder_decodes():
    # Across a wrap of the 24-bit sensor time.
    t, x, y, p = line_events(np.random.default_rng(SEED), flat, periods=5)
    data = Encoder().encode(t + (1 << 24) - 30_000, x, y, p)
    events = Decoder().decode(data)
    t, x, y = reference.decode_all(data)
    np.testing.assert_array_equal(x, events.x)
    np.testing.assert_array_equal(y, events.y)
    np.testing.assert_array_equal(t, events.t)


def test_same_rows_and_ranges_as_the_streaming_mean():
    events = line_events(np.random.default_rng(SEED), flat, periods=5)
    t, x, y = reference.decode_all(encoded(events))
    plain = reference.reconstruct(t, x, y, CALIBRATION.model(), MODULATION)
    settings = Settings(centroid="mean", smoothing_half_width=0, isolation_events=0)
    reconstructor = Reconstructor(CALIBRATION, MODULATION, settings)
    ours = Profiles.concatenate([reconstructor.push(encoded(events)), reconstructor.flush()])
    np.testing.assert_array_equal(plain.period, ours.period)
    np.testing.assert_array_equal(plain.edge_us, ours.edge_us)
    np.testing.assert_array_equal(plain.column, ours.column)
    np.testing.assert_array_equal(plain.events, ours.events)
    np.testing.assert_allclose(plain.row, ours.row, rtol=0, atol=1e-10)
    np.testing.assert_allclose(plain.range_mm, ours.range_mm, rtol=1e-12)
    np.testing.assert_allclose(plain.width_px, ours.width_px, rtol=1e-9)
    np.testing.assert_array_equal(plain.return_index, ours.return_index)
    assert np.abs(plain.t_us - ours.t_us).max() <= 1


def test_background_pulls_the_plain_mean_but_not_the_default():
    events = line_events(np.random.default_rng(SEED), flat, periods=5)
    t, x, y = events[:3]
    plain = reference.reconstruct(t, x, y, CALIBRATION.model(), MODULATION)
    reconstructor = Reconstructor(CALIBRATION, MODULATION)
    ours = Profiles.concatenate([reconstructor.push(encoded(events)), reconstructor.flush()])
    plain_error = np.abs(plain.row - 350.0).mean()
    assert np.abs(ours.row - 350.0).mean() < 0.3 * plain_error, f"seed {SEED}"


def test_no_events_no_points():
    none = np.empty(0, dtype=int)
    assert len(reference.reconstruct(none, none, none, CALIBRATION.model(), MODULATION)) == 0


def test_unequal_lengths_are_refused():
    with pytest.raises(ArgumentError):
        reference.reconstruct([1, 2], [1], [1], CALIBRATION.model(), MODULATION)
