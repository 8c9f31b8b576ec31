"""Posts: where they are seen, and that they hide what is behind them."""

from dataclasses import replace

import numpy as np
import pytest

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.simulation.scenes import Post, Posts, bench, named

CALIBRATION = replace(load_calibration("config_3"), b_mm=7.0)
MODEL = CALIBRATION.model()
COLUMNS = np.arange(1280)


def test_nine_posts_lie_side_by_side_from_820_to_2050_mm():
    scene = named("posts")
    assert isinstance(scene, Posts)
    assert [scene.posts[end].range_mm for end in (0, -1)] == [820.0, 2050.0]
    seen = scene.range_mm([0.0, 90.0], COLUMNS, MODEL)
    assert np.array_equal(seen[0], seen[1], equal_nan=True)
    for post in scene.posts:
        left, right = post.columns(MODEL)
        assert 0.0 < left < right < 1279.0
        inside = (left < COLUMNS) & (right > COLUMNS)
        assert np.array_equal(seen[0] == post.range_mm, inside), post
    assert np.isnan(seen).mean() > 0.3


def test_a_flat_post_covers_the_columns_its_size_says():
    post = Post(1400.0, -60.0, 25.4)
    left, right = post.columns(MODEL)
    assert right - left == pytest.approx(25.4 * MODEL.k_mm / (1407.0 * 4.86e-3), rel=1e-12)
    middle = MODEL.lateral_mm(0.5 * (left + right), 1400.0)
    assert float(middle) == pytest.approx(-60.0, rel=1e-12)


def test_hits_lie_on_the_front_of_a_round_post():
    post = Post(1400.0, -60.0, 25.4, round=True)
    x = Posts((post,)).range_mm([0.0], COLUMNS, MODEL)[0]
    left, right = post.columns(MODEL)
    hit = np.isfinite(x)
    assert np.array_equal(hit, (left < COLUMNS) & (right > COLUMNS))
    z = MODEL.lateral_mm(COLUMNS[hit], x[hit])
    assert np.max(np.abs(np.hypot(x[hit] - 1412.7, z + 60.0) - 12.7)) < 1e-9
    assert x[hit].max() < 1412.7
    assert np.min(x[hit]) == pytest.approx(1400.0, abs=0.02)


def test_the_nearest_post_hides_the_others_and_the_backdrop():
    scene = Posts((Post(1500.0, 0.0, 60.0), Post(1200.0, 0.0, 20.0)), backdrop_mm=2000.0)
    x = scene.range_mm([0.0], COLUMNS, MODEL)[0]
    assert x[640] == 1200.0
    assert set(np.unique(x)) == {1200.0, 1500.0, 2000.0}


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Post(-1.0, 0.0, 10.0), "range_mm is -1.0"),
        (lambda: Post(900.0, 0.0, 0.0), "size_mm is 0.0"),
        (lambda: Post(900.0, np.nan, 10.0), "line_mm is nan"),
        (lambda: bench([900.0] * 10), "10 posts"),
        (lambda: Posts(()), "at least one"),
    ],
)
def test_impossible_posts_are_refused(make, words):
    with pytest.raises(ArgumentError, match=words):
        make()
