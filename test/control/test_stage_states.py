"""The states that the odometry publishes after stalls and settings of the clock."""

import pytest
from apt_bench import AptBench

from eschorty_ros.control.stage_states import FILL_MAX, states_since

PERIOD_NS = 10_000_000


def times_since(bench, last_ns):
    return [state.t_ns for state in states_since(bench.stage, last_ns, PERIOD_NS)]


def test_a_stall_is_filled_and_a_long_one_is_not():
    bench = AptBench()
    (first,) = times_since(bench, 0)
    assert times_since(bench, first) == []
    bench.advance(0.5)
    filled = times_since(bench, first)
    assert filled[:-1] == [first + k * PERIOD_NS for k in range(1, len(filled))]
    assert len(filled) > 30
    assert PERIOD_NS / 2 <= filled[-1] - filled[-2] <= 3 * PERIOD_NS / 2
    bench.advance((FILL_MAX + 10) * PERIOD_NS * 1e-9)
    assert len(times_since(bench, filled[-1])) == 1


@pytest.mark.parametrize("back_s", [2, 3600])
def test_a_clock_set_back_does_not_end_the_odometry(back_s):
    bench = AptBench()
    last_ns = times_since(bench, 0)[-1]
    bench.clock_set_ns = -back_s * 1_000_000_000
    bench.advance(0.1)
    (last_ns,) = times_since(bench, last_ns)
    assert abs(last_ns - bench.host_clock_ns()) < 200_000_000
    bench.advance(0.2)
    assert len(times_since(bench, last_ns)) > 5


def test_a_stage_at_rest_has_five_states_per_second_and_none_is_missing_when_it_moves():
    bench = AptBench()
    bench.advance(0.5)
    (last,) = states_since(bench.stage, 0, PERIOD_NS)
    assert not last.moving
    bench.advance(0.05)
    assert states_since(bench.stage, last.t_ns, PERIOD_NS, rested=True) == []
    bench.advance(0.2)
    (rest,) = states_since(bench.stage, last.t_ns, PERIOD_NS, rested=True)
    bench.advance(0.5)
    assert len(states_since(bench.stage, rest.t_ns, PERIOD_NS, rested=True)) > 20
    bench.stage.move_to(10.0, 50.0)
    bench.advance(0.2)
    moved = states_since(bench.stage, rest.t_ns, PERIOD_NS, rested=True)
    assert len(moved) > 10
    assert moved[-1].moving
    assert max(b.t_ns - a.t_ns for a, b in zip([rest, *moved], moved, strict=False)) < 2 * PERIOD_NS
