"""From events to targets: posts found in a frame, and matched to what is known of them."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from eschorty_ros.core.base.errors import ArgumentError, FitError
from eschorty_ros.core.calibration import (
    AggregateFrame,
    KnownTarget,
    Post,
    Targets,
    find_posts,
    fit,
    match_posts,
)
from eschorty_ros.core.evt3 import Decoder
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.simulation.scenes import Posts, bench
from eschorty_ros.simulation.world import World

NOMINAL = load_calibration("config_3").model()
AS_BUILT = replace(NOMINAL, k_prime_px=0.96 * NOMINAL.k_prime_px, b_prime_px=-1102.74)
BENCH = bench()
KNOWN = [KnownTarget(post.range_mm, size_mm=post.size_mm) for post in BENCH]


def capture(scene: Posts, seed: int, duration_us: int = 500_000) -> AggregateFrame:
    calibration = replace(
        load_calibration("config_3"), k_prime_px=AS_BUILT.k_prime_px, b_prime_px=AS_BUILT.b_prime_px
    )
    world = World(scene, calibration, seed=seed)
    world.set_laser(0, True, Modulation(70.0, on_edge_us=0))
    decoder, frame = Decoder(1280, 720), AggregateFrame(1280, 720)
    while world.now_us < duration_us:
        frame.add(decoder.decode(world.advance(world.now_us + 100_000)))
    assert frame.events == world.events > 100_000
    return frame


@pytest.fixture(scope="module")
def frame() -> AggregateFrame:
    return capture(Posts(BENCH), seed=3)


@pytest.mark.parametrize("round_", [False, True], ids=["flat", "round"])
def test_every_post_is_found_with_row_middle_and_width(frame, round_):
    scene = Posts(tuple(replace(post, round=round_) for post in BENCH))
    posts = find_posts(capture(scene, seed=4) if round_ else frame)
    assert len(posts) == len(BENCH)
    for seen, post in zip(posts, scene.posts, strict=True):
        left, right = post.columns(AS_BUILT)
        row_error = seen.row - float(AS_BUILT.row(post.range_mm))
        print(f"{post.range_mm:7.1f} mm: row off by {row_error:+.3f}, sigma {seen.sigma_row:.3f}")
        assert abs(row_error) < 3.0 * seen.sigma_row < 0.6
        assert abs(seen.column - 0.5 * (left + right)) < 0.7
        assert abs(seen.width_px - (right - left)) < 3.0 * seen.sigma_width_px
        assert (seen.row_cut, seen.column_cut) == (False, False)


def test_a_backdrop_is_no_known_target(frame):
    posts = find_posts(capture(Posts(BENCH[2:7], backdrop_mm=2150.0), seed=5))
    result = match_posts(posts, KNOWN[2:7], NOMINAL)
    assert result.targets.range_mm.tolist() == [known.range_mm for known in KNOWN[2:7]]
    assert sum("no known target" in line for line in result.rejected) == len(posts) - 5 > 0


def test_cut_posts_are_flagged():
    rng = np.random.default_rng(6)
    frame = AggregateFrame(200, 720)
    for first, last, row in ((0, 30, 300.0), (60, 90, 4.0), (120, 150, 400.0), (170, 199, 500.0)):
        x = np.repeat(np.arange(first, last + 1), 60)
        y = np.clip(np.rint(rng.normal(row, 6.0, x.size)), 0, 719)
        frame.add(SimpleNamespace(x=x.astype(np.uint16), y=y.astype(np.uint16)))
    posts = find_posts(frame)
    assert [(post.row_cut, post.column_cut) for post in posts] == [
        (False, True), (True, False), (False, False), (False, True)
    ]  # fmt: skip


def test_hot_and_dead_pixels_and_dark_columns_do_not_matter(frame):
    spoilt = AggregateFrame(1280, 720)
    spoilt.counts[:] = frame.counts
    rng = np.random.default_rng(7)
    spoilt.counts[rng.integers(0, 720, 40), rng.integers(0, 1280, 40)] = 100_000
    spoilt.counts[:, [358, 359, 640]] = 0
    clean, posts = find_posts(frame), find_posts(spoilt)
    assert len(posts) == len(clean)
    for one, other in zip(clean, posts, strict=True):
        assert abs(one.row - other.row) < 0.1
        assert abs(one.width_px - other.width_px) < 0.1


def test_a_post_whose_middle_is_dark_is_none():
    rng = np.random.default_rng(9)
    frame = AggregateFrame(200, 720)
    columns = np.arange(50, 91)
    # Weak in five columns around the middle, which itself is dark.
    for x, events in zip(columns, np.where(np.abs(columns - 70) <= 2, 15, 120), strict=True):
        y = np.rint(rng.normal(300.0, 6.0, events if x != 70 else 0)).astype(np.uint16)
        frame.add(SimpleNamespace(x=np.full(y.size, x, np.uint16), y=y))
    assert find_posts(frame) == []


def test_a_dark_frame_holds_no_posts():
    frame = AggregateFrame(1280, 720)
    assert find_posts(frame) == []
    rng = np.random.default_rng(8)
    frame.counts[:] = rng.poisson(0.5, frame.counts.shape)
    assert find_posts(frame) == []


def test_nine_posts_give_back_the_geometry(frame):
    result = match_posts(find_posts(frame), KNOWN, NOMINAL)
    assert result.pairs == tuple((i, i) for i in range(9))
    assert result.rejected == ()
    targets = result.targets
    found = fit(Targets(targets.row, targets.range_mm, targets.sigma_row_px), NOMINAL)
    true_mm = np.linspace(800.0, 2100.0, 131)
    error = found.model.range_mm(AS_BUILT.row(true_mm)) - true_mm
    before = NOMINAL.range_mm(AS_BUILT.row(true_mm)) - true_mm
    rms_mm = float(np.sqrt(np.mean(error**2)))
    print(f"range RMS {rms_mm:.3f} mm after, {np.sqrt(np.mean(before**2)):.1f} mm before")
    assert rms_mm < 1.0
    assert found.reduced_chi_square < 3.0


def post(column: float, range_mm: float, width_px: float = 40.0, shift_px: float = 0.0) -> Post:
    row = float(AS_BUILT.row(range_mm)) + shift_px
    return Post(column, row, 0.15, width_px, 0.4, 1000)


def ranges(*values: float) -> list[KnownTarget]:
    return [KnownTarget(value) for value in values]


def test_order_does_not_matter_and_what_is_missing_is_named():
    posts = [post(100.0 * i, r) for i, r in enumerate((2000.0, 900.0, 1500.0, 1250.0))]
    result = match_posts(posts, ranges(1500.0, 1700.0, 2000.0, 900.0, 1250.0), NOMINAL)
    assert result.pairs == ((1, 3), (3, 4), (2, 0), (0, 2))
    row = float(AS_BUILT.row(1700.0))
    assert result.rejected == (f"target 1700 mm: no fitting post near row {row:.1f}",)


def test_posts_of_a_line_with_roll_and_smile_are_matched():
    bend = {"b_prime_1_px": 15.0, "b_prime_2_px": 5.0}
    bent, known = replace(AS_BUILT, **bend), (850.0, 1000.0, 1200.0, 1500.0, 1900.0)
    columns = (1200.0, 60.0, 900.0, 350.0, 640.0)
    posts = [
        replace(post(column, r), row=float(bent.row(r, column)))
        for column, r in zip(columns, known, strict=True)
    ]
    assert len(match_posts(posts, ranges(*known), replace(NOMINAL, **bend)).pairs) == 5
    with pytest.raises(FitError, match="3 of 5 posts agree with the known ranges"):
        match_posts(posts, ranges(*known), NOMINAL)


def test_a_displaced_post_is_rejected_by_name():
    known = (850.0, 1000.0, 1200.0, 1500.0, 1900.0)
    posts = [post(100.0 * i, r, shift_px=12.0 * (r == 1200.0)) for i, r in enumerate(known)]
    result = match_posts(posts, ranges(*known), NOMINAL)
    assert [pair[1] for pair in result.pairs] == [0, 1, 3, 4]
    assert len(result.rejected) == 2
    assert result.rejected[0].startswith("post at column 200")
    assert result.rejected[1].startswith("target 1200 mm")


def test_sizes_identify_posts_that_ranges_alone_do_not():
    # Two known ranges fit three evenly spaced rows in two ways.
    rows = AS_BUILT.row([1100.0, 1300.0])
    third = float(AS_BUILT.range_mm(2.0 * rows[1] - rows[0]))
    widths = {1100.0: 60.0, 1300.0: 100.0, third: 30.0}
    posts = [post(200.0 * i, r, w) for i, (r, w) in enumerate(widths.items())]
    with pytest.raises(FitError, match="more than one way"):
        match_posts(posts, ranges(1100.0, 1300.0), NOMINAL)
    pitch = NOMINAL.pixel_um * 1e-3
    known = [KnownTarget(r, size_mm=widths[r] * pitch * r / NOMINAL.k_mm) for r in (1100.0, 1300.0)]
    assert match_posts(posts, known, NOMINAL).pairs == ((0, 0), (1, 1))


def test_hints_come_before_ranges():
    posts = [post(100.0, 1200.0), post(500.0, 1200.0), post(900.0, 1500.0)]
    known = [KnownTarget(1200.0, column=505.0, label="left"), KnownTarget(1500.0, column=903.0)]
    result = match_posts(posts, known, NOMINAL)
    assert result.pairs == ((1, 0), (2, 1))
    assert result.targets.labels == ("left", "1500 mm")
    row = f"{posts[0].row:.1f}"
    assert result.rejected == (f"post at column 100, row {row}: it matches no known target",)
    result = match_posts(posts, [KnownTarget(1200.0, column=300.0)], NOMINAL)
    assert result.targets is None
    assert "target 1200 mm: no uncut post near its pixel hint" in result.rejected


def test_cut_lines_are_rejected_with_the_reason():
    known = (900.0, 1200.0, 1400.0, 1700.0)
    posts = [replace(post(100.0 * i, r), row_cut=r == 900.0) for i, r in enumerate(known)]
    result = match_posts(posts, ranges(*known), NOMINAL)
    assert [pair[0] for pair in result.pairs] == [1, 2, 3]
    assert "edge cuts its line" in result.rejected[0]


def test_a_post_that_the_edge_of_the_columns_cuts_keeps_its_row_and_column_alone():
    known = (900.0, 1200.0, 1400.0)
    posts = [replace(post(100.0 * i, r), column_cut=i == 0) for i, r in enumerate(known)]
    targets = match_posts(posts, ranges(*known), NOMINAL).targets
    assert targets.column.tolist() == [0.0, 100.0, 200.0]
    assert np.isnan(targets.width_px).tolist() == [True, False, False]


def test_posts_of_a_camera_that_is_upside_down_are_refused(frame):
    turned = [
        replace(post, row=719.0 - post.row, column=1279.0 - post.column)
        for post in find_posts(frame)
    ]
    known = [replace(known, size_mm=np.nan) for known in KNOWN]
    with pytest.raises(FitError, match=r"^9 posts agree .* upside down; .* write 719 - row$"):
        match_posts(turned, known, NOMINAL)
    # Of the near ones no two are on a line of a build like the nominal one.
    with pytest.raises(FitError, match=r"^3 posts agree .* write 719 - row$"):
        match_posts(sorted(turned, key=lambda post: -post.row)[:3], known[:3], NOMINAL)


def test_no_post_at_all_is_no_error_here():
    result = match_posts([], ranges(1000.0, 1500.0), NOMINAL)
    assert result.targets is None
    assert len(result.rejected) == 2


def test_lists_that_identify_no_post_are_refused():
    twins = [KnownTarget(1000.0, label=label) for label in "ab"]
    for known, words in (([], "known is empty"), (twins, "a and b have the same")):
        with pytest.raises(ArgumentError, match=words):
            match_posts([], known, NOMINAL)


def test_full_pixels_stay_full_and_events_outside_are_counted():
    frame = AggregateFrame(4, 3)
    frame.counts[1, 2] = 2**32 - 1
    x, y = np.array([[2, 2, 4, 0], [1, 1, 0, 3]], np.uint16)
    frame.add(SimpleNamespace(x=x, y=y))
    assert frame.counts[1, 2] == 2**32 - 1
    assert frame.events == 2
    with pytest.raises(ArgumentError, match="y is int64"):
        frame.add(SimpleNamespace(x=x, y=y.astype(np.int64)))
    assert frame.image().max() == 255
    assert AggregateFrame(4, 3).image().max() == 0
