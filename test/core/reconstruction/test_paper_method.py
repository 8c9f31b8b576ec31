"""The paper's method agrees with the streaming `mean`; background is why it is no default."""

import numpy as np
import pytest
from line_events import encoded, line_events
from reconstructing import CALIBRATION, KNOWN, reconstruct

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.evt3 import Decoder, Encoder
from eschorty_ros.core.reconstruction import Settings, paper_method

SEED = 8


def flat(k, c):
    return np.full(c.shape, 350.0)


def test_numpy_decodes_what_the_decoder_decodes():
    # Across a wrap of the 24-bit sensor time.
    t, x, y, p = line_events(np.random.default_rng(SEED), flat, periods=5)
    data = Encoder().encode(t + (1 << 24) - 30_000, x, y, p)
    events = Decoder().decode(data)
    t, x, y = paper_method.decode_all(data)
    np.testing.assert_array_equal(x, events.x)
    np.testing.assert_array_equal(y, events.y)
    np.testing.assert_array_equal(t, events.t)


def test_same_rows_and_ranges_as_the_streaming_mean():
    events = line_events(np.random.default_rng(SEED), flat, periods=5)
    t, x, y = paper_method.decode_all(encoded(events))
    plain = paper_method.reconstruct(t, x, y, CALIBRATION.model(), KNOWN)
    settings = Settings(centroid="mean", smoothing_half_width=0, isolation_events=0)
    ours, _ = reconstruct(encoded(events), settings=settings)
    for name in ("period", "edge_us", "column", "events", "return_index"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(ours, name), name)
    np.testing.assert_allclose(plain.row, ours.row, rtol=0, atol=1e-10)
    np.testing.assert_allclose(plain.range_mm, ours.range_mm, rtol=1e-12)
    np.testing.assert_allclose(plain.width_px, ours.width_px, rtol=1e-9)
    assert np.abs(plain.t_us - ours.t_us).max() <= 1


def test_background_pulls_the_plain_mean_but_not_the_default():
    events = line_events(np.random.default_rng(SEED), flat, periods=5)
    t, x, y = events[:3]
    plain = paper_method.reconstruct(t, x, y, CALIBRATION.model(), KNOWN)
    ours, _ = reconstruct(encoded(events))
    plain_error = np.abs(plain.row - 350.0).mean()
    assert np.abs(ours.row - 350.0).mean() < 0.3 * plain_error, f"seed {SEED}"


def test_no_events_no_points():
    none = np.empty(0, dtype=int)
    assert len(paper_method.reconstruct(none, none, none, CALIBRATION.model(), KNOWN)) == 0


def test_unequal_lengths_are_refused():
    with pytest.raises(ArgumentError):
        paper_method.reconstruct([1, 2], [1], [1], CALIBRATION.model(), KNOWN)
