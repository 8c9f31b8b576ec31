"""Which states of the stage are told, whatever its clock does."""

import pytest
from apt_bench import AptBench

pytest.importorskip("rclpy", reason="rclpy is not installed")

from eschorty_ros.control.stage_states import FILL_MAX, new_states

PERIOD_NS = 10_000_000


def told_after(bench, told_ns):
    return [state.t_ns for state in new_states(bench.stage, told_ns, PERIOD_NS)]


def test_a_pause_is_filled_and_a_long_one_is_not():
    bench = AptBench()
    (first,) = told_after(bench, 0)
    assert told_after(bench, first) == []
    bench.advance(0.5)
    filled = told_after(bench, first)
    assert filled[:-1] == [first + k * PERIOD_NS for k in range(1, len(filled))]
    assert len(filled) > 30
    assert PERIOD_NS / 2 <= filled[-1] - filled[-2] <= 3 * PERIOD_NS / 2
    bench.advance((FILL_MAX + 10) * PERIOD_NS * 1e-9)
    assert len(told_after(bench, filled[-1])) == 1


@pytest.mark.parametrize("back_s", [2, 3600])
def test_a_clock_set_back_does_not_end_the_odometry(back_s):
    bench = AptBench()
    told_ns = told_after(bench, 0)[-1]
    bench.clock_set_ns = -back_s * 1_000_000_000
    bench.advance(0.1)
    (told_ns,) = told_after(bench, told_ns)
    assert abs(told_ns - bench.host_clock_ns()) < 200_000_000
    bench.advance(0.1)
    assert len(told_after(bench, told_ns)) > 5
