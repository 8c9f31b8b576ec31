"""Stage positions at sensor times."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.clocks import StageTrack, quantise_nm

EPOCH_US = 1_760_000_000_000_000


def track(*samples: tuple[int, float], max_gap_us: int | None = None) -> StageTrack:
    stage = StageTrack(max_gap_us)
    for t_us, position_mm in samples:
        stage.append(t_us, position_mm)
    return stage


def test_samples_are_returned_as_the_decimal_they_were():
    stage = track((5, 123.456789), (10, -0.000001), (11, 220.0))
    assert stage.position_mm([5, 10, 11]).tolist() == [123.456789, -1e-6, 220.0]


def test_samples_that_go_back_are_dropped_and_counted():
    stage = track((100, 1.0))
    stage.append([90, 100, 200, 150, 200, 300], [9.0, 9.0, 2.0, 9.0, 9.0, 3.0])
    assert stage.dropped == 4
    assert (len(stage), stage.first_us, stage.last_us) == (3, 100, 300)
    np.testing.assert_array_equal(stage.position_mm([100, 150, 250]), [1.0, 1.5, 2.5])


def test_dropping_keeps_what_later_queries_need():
    stage = StageTrack()
    for t_us in range(0, 20_000, 10):
        stage.append(t_us, t_us * 1e-3)
        if t_us >= 500:
            stage.drop_before(t_us - 495)
            assert len(stage) <= 52
            assert stage.position_mm([t_us - 495])[0] == pytest.approx((t_us - 495) * 1e-3)
    assert (stage.first_us, stage.last_us) == (19_490, 19_990)
    stage.drop_before(10**9)
    assert (len(stage), stage.first_us) == (1, 19_990)
    empty = StageTrack()
    empty.drop_before(5)
    assert (empty.first_us, empty.last_us) == (None, None)


@settings(derandomize=True, max_examples=100, deadline=None)
@given(
    st.lists(st.tuples(st.integers(-1000, 1000), st.floats(-100, 100)), max_size=600),
    st.integers(1, 600),
)
def test_one_by_one_and_in_blocks_are_the_same(samples, block):
    one, blocks = StageTrack(50), StageTrack(50)
    for t_us, position_mm in samples:
        one.append(t_us, position_mm)
    for start in range(0, len(samples), block):
        part = samples[start : start + block]
        blocks.append([s[0] for s in part], [s[1] for s in part])
    query = np.arange(-1001, 1002)
    assert one.position_mm(query).tobytes() == blocks.position_mm(query).tobytes()
    assert (one.dropped, len(one)) == (blocks.dropped, len(blocks))
    assert one.dropped + len(one) == len(samples)


def test_positions_stay_between_their_samples():
    rng = np.random.default_rng(11)
    t_us = EPOCH_US + np.cumsum(rng.integers(1, 5000, 300))
    position = rng.uniform(0.0, 220.0, 300)
    stage = StageTrack()
    stage.append(t_us, position)
    query = rng.integers(t_us[0], t_us[-1] + 1, 20_000)
    found = stage.position_mm(query)
    expected = np.interp(query - t_us[0], t_us - t_us[0], position)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1.1e-6)
    left = np.searchsorted(t_us, query, side="right") - 1
    right = np.minimum(left + 1, 299)
    ends = np.sort([position[left], position[right]], axis=0)
    assert ((found >= ends[0] - 6e-7) & (found <= ends[1] + 6e-7)).all()


def test_a_position_for_each_time_is_needed():
    with pytest.raises(ArgumentError, match="one position for each time"):
        StageTrack().append([1, 2], [1.0])


def test_quantisation_is_to_the_nanometre():
    assert quantise_nm([0.0000004, 0.0000006, -1.5, 199.9999999]).tolist() == [
        0, 1, -1_500_000, 200_000_000,
    ]  # fmt: skip
