"""Activity filter: keeps the laser line, removes what stands alone, however the stream is cut."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eschorty_ros.core.evt3 import ActivityFilter, Events, Triggers

NO_TRIGGERS = Triggers(np.empty(0, np.int64), np.empty(0, np.uint8), np.empty(0, np.uint8))


def events_of(t, x, y, p=None) -> Events:
    t = np.asarray(t, dtype=np.int64)
    p = np.zeros(t.size) if p is None else p
    return Events(
        t, np.asarray(x, np.uint16), np.asarray(y, np.uint16), np.asarray(p, np.uint8), NO_TRIGGERS
    )


def kept(events: Events, **settings: int) -> list[tuple[int, int, int, int]]:
    return ActivityFilter(**settings).filter(events).packed().tolist()


def simulated_line(rng: np.random.Generator, periods: int = 8) -> tuple[Events, np.ndarray]:
    """A line of 20 rows FWHM at 70 Hz on all columns, ON and OFF bursts, 5 % uniform background."""
    parts = []
    period_us = 1e6 / 70
    column = np.arange(1280)
    for k in range(periods):
        row = 360 + 60 * np.sin(column / 200 + k / 5)
        for half, polarity in ((0.0, 1), (0.5, 0)):
            x = np.repeat(column, rng.poisson(11, 1280))
            delay = rng.gamma(4.0, 60.0, x.size)
            t = 1000 + (k + half) * period_us + delay
            parts.append((t, x, row[x] + rng.normal(0, 20 / 2.355, x.size), polarity, True))
    total = sum(part[0].size for part in parts)
    n = int(total * 0.05 / 0.95)
    t, x, y = (
        rng.uniform(0, periods * period_us, n),
        rng.integers(0, 1280, n),
        rng.integers(0, 720, n),
    )
    parts.append((t, x, y, 1, False))
    t, x, y = (np.concatenate([part[k] for part in parts]).astype(np.int64) for k in range(3))
    signal = np.concatenate([np.full(part[0].size, part[4]) for part in parts])
    order = np.argsort(t, kind="stable")
    return events_of(t[order], x[order], y[order], signal[order]), signal[order]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_line_stays_and_isolated_events_go(seed: int) -> None:
    print("seed", seed)
    events, signal = simulated_line(np.random.default_rng(seed))
    found = ActivityFilter().filter(events)
    # The polarity carries the truth here: the filter passes it through.
    line_kept = int(found.p.sum()) / int(signal.sum())
    noise_removed = 1 - int((found.p == 0).sum()) / int((~signal).sum())
    assert line_kept >= 0.97
    assert noise_removed >= 0.90


def test_support_needs_another_pixel_nearby_and_recently() -> None:
    assert kept(events_of([0, 10], [100, 101], [50, 50])) == [(10, 101, 50, 0)]
    assert kept(events_of([0, 10], [100, 100], [50, 50])) == []
    assert kept(events_of([0, 501], [100, 101], [50, 50])) == []
    assert kept(events_of([0, 500], [100, 101], [50, 50])) == [(500, 101, 50, 0)]
    assert kept(events_of([0, 10], [100, 112], [50, 50])) == []
    assert kept(events_of([0, 10], [100, 111], [50, 50])) == [(10, 111, 50, 0)]
    assert kept(events_of([0, 10], [100, 100], [50, 56])) == []
    assert kept(events_of([0, 10], [100, 100], [50, 55])) == [(10, 100, 55, 0)]


def test_hot_pixel_does_not_support_itself() -> None:
    t = np.arange(0, 100_000, 20)
    pixel_filter = ActivityFilter()
    assert len(pixel_filter.filter(events_of(t, np.full(t.size, 7), np.full(t.size, 9)))) == 0


def test_first_events_have_no_support_at_any_time() -> None:
    for origin in (0, 1, 1_700_000_000_000_000):
        assert kept(events_of([origin, origin + 1], [0, 1279], [0, 719])) == []


@pytest.mark.parametrize("pause_us", [600, 1 << 25, (1 << 26) + 3, 1 << 31, 1 << 45])
def test_long_pauses_are_no_support(pause_us: int) -> None:
    t = [5, 6, 6 + pause_us, 7 + pause_us]
    expected = [(6, 11, 20, 0), (7 + pause_us, 11, 20, 0)]
    assert kept(events_of(t, [10, 11, 10, 11], [20] * 4)) == expected


def test_support_across_the_rebase() -> None:
    border = 1 << 25
    t = [0, border - 100, border + 100]
    assert kept(events_of(t, [10, 10, 11], [20] * 3)) == [(border + 100, 11, 20, 0)]


def plain_filter(events: Events, window_us: int) -> list[tuple[int, int, int, int]]:
    newest: dict[tuple[int, int], tuple[int, int, int]] = {}
    found = []
    for t, x, y, p in events.packed().tolist():
        near = [newest.get((x // 8 + dx, y // 4 + dy)) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
        if any(e and t - e[0] <= window_us and e[1:] != (x, y) for e in near):
            found.append((t, x, y, p))
        newest[x // 8, y // 4] = (t, x, y)
    return found


@settings(max_examples=100, deadline=None, derandomize=True)
@given(
    st.lists(
        st.tuples(
            st.sampled_from([0, 0, 1, 40, 50, 51, 1 << 25]), st.integers(0, 36), st.integers(0, 20)
        ),
        max_size=60,
    ),
    st.lists(st.integers(0, 60), max_size=4),
)
def test_equals_the_plain_rule_however_cut(steps: list, cuts: list[int]) -> None:
    dt, x, y = ([step[k] for step in steps] for k in range(3))
    events = events_of(np.cumsum(dt), x, y)
    streaming = ActivityFilter(37, 21, window_us=50)
    found = []
    edges = [0, *sorted(min(cut, len(events)) for cut in cuts), len(events)]
    for a, b in pairwise(edges):
        part = Events(events.t[a:b], events.x[a:b], events.y[a:b], events.p[a:b], NO_TRIGGERS)
        found += streaming.filter(part).packed().tolist()
    assert found == plain_filter(events, 50)


def test_outside_events_are_not_written() -> None:
    small = ActivityFilter(10, 10)
    assert len(small.filter(events_of([0, 1, 2], [3, 10, 65535], [3, 3, 3]))) == 0
