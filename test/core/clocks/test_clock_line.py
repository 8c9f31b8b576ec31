"""Two clocks as a straight line in whole numbers."""

from fractions import Fraction
from math import floor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.clocks import ClockLine

EPOCH_US = 1_760_000_000_000_000
TIMES = st.integers(-(2**48), 2**48)


@settings(derandomize=True, max_examples=300, deadline=None)
@given(TIMES, TIMES, st.integers(-200_000, 200_000), st.integers(-(2**60), 2**60))
def test_conversion_is_the_exact_line_and_undone_exactly(t_us, origin_us, drift_ppb, origin_ns):
    line = ClockLine(origin_us, origin_ns, drift_ppb)
    since = t_us - origin_us
    exact = origin_ns + since * 1000 + Fraction(since * drift_ppb, 10**6)
    assert line.to_ns(t_us) == floor(exact)
    assert line.to_us(line.to_ns(t_us)) == t_us
    both = line.to_ns(np.array([t_us], np.int64))
    assert both.dtype == np.int64
    assert (int(both[0]), int(line.to_us(both)[0])) == (line.to_ns(t_us), t_us)


@pytest.mark.parametrize("drift_ppb", [-200_000, -1, 0, 1, 50_000])
def test_time_increases_strictly_at_54_years(drift_ppb):
    line = ClockLine(EPOCH_US, EPOCH_US * 1000, drift_ppb)
    t_ns = line.to_ns(EPOCH_US + np.arange(-5000, 5000))
    assert (np.diff(t_ns) >= 999).all()
    assert (np.diff(t_ns) <= 1001).all()


def test_nanoseconds_between_go_to_the_nearest():
    line = ClockLine(10, 5_000, 100_000)
    assert [line.to_us(5_000 + ns) for ns in (-501, -500, 0, 499, 500, 1501)] == [
        9, 10, 10, 10, 11, 12,
    ]  # fmt: skip


def test_shift():
    assert ClockLine(3, 5, 7).shifted(-10) == ClockLine(3, -5, 7)


def test_beyond_the_range_is_refused():
    with pytest.raises(ArgumentError, match="drift_ppb is 200001"):
        ClockLine(0, 0, 200_001)
    line = ClockLine(2**51, 0, 5)
    with pytest.raises(ArgumentError, match="t_us holds"):
        line.to_ns(np.array([-(2**51)]))
    with pytest.raises(ArgumentError, match="float64"):
        line.to_ns(np.array([0.5]))
