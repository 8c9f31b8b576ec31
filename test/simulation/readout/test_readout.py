"""The row arbiter, its limits, and what the stream says of losses."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.evt3 import Decoder
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.simulation.pixels import unpack
from eschorty_ros.simulation.readout import EventRate, Readout, ReadoutParameters
from eschorty_ros.simulation.scenes import Plane
from eschorty_ros.simulation.world import SensorControl, World

SEED = 4
SMALL = replace(load_calibration("config_3"), columns=96, principal_column=None)


def keys(t, y, x, p=1) -> np.ndarray:
    t, y, x, p = np.broadcast_arrays(t, y, x, p)
    return np.sort(t.astype(np.int64) << 22 | y << 12 | p << 11 | x)


def burst(rng: np.random.Generator, events: int, span_us: int = 400) -> np.ndarray:
    """Events of 20 rows and 100 columns within a short time."""
    return np.unique(
        keys(rng.integers(1000, 1000 + span_us, events), rng.integers(300, 320, events),
             rng.integers(0, 100, events), rng.integers(0, 2, events))
    )  # fmt: skip


def test_a_row_is_read_out_completely_and_rows_wait_for_each_other() -> None:
    readout = Readout(720, ReadoutParameters(row_time_us=10.0))
    requests = keys([100, 101, 103, 100, 104], [5, 5, 5, 9, 9], [1, 2, 3, 4, 5])
    out, drops, periods = readout.read_out(requests, 1000)
    t, x, y, _ = unpack(out)
    # The request of row 5 is first and alone; later ones wait until row 9 is done.
    assert list(zip(t.tolist(), y.tolist(), x.tolist(), strict=True)) == [
        (100, 5, 1), (110, 9, 4), (110, 9, 5), (120, 5, 2), (120, 5, 3),
    ]  # fmt: skip
    assert (drops.size, periods.size) == (0, 0)


def test_slow_rows_bundle_events_and_lose_none() -> None:
    print(f"seed {SEED}")
    requests = burst(np.random.default_rng(SEED), 3000)
    readout = Readout(720, ReadoutParameters(row_time_us=5.0))
    out = readout.read_out(requests, 10_000).keys
    mask = (1 << 22) - 1
    assert np.array_equal(np.unique(out & mask), np.unique(requests & mask))
    assert readout.dropped == 0
    assert readout.merged == requests.size - out.size
    t = out >> 22
    rows = np.unique(np.stack((t, out >> 12 & 0x3FF)), axis=1)
    assert np.diff(np.unique(rows[0])).min() >= 5
    assert rows.shape[1] < requests.size / 10


def test_cutting_the_calls_changes_nothing() -> None:
    print(f"seed {SEED}")
    rng = np.random.default_rng(SEED)
    requests = burst(rng, 5000, 3000)

    def tight() -> Readout:
        readout = Readout(720, ReadoutParameters(row_time_us=7.0, waiting_max=100))
        readout.limit(0, EventRate(160, 200))
        return readout

    uncut = tight()
    expected = uncut.read_out(requests, 20_000)
    assert uncut.dropped > 100
    assert uncut.rate_dropped > 100
    parts, readout = [], tight()
    times = np.unique(np.append(rng.integers(1000, 6000, 60), [0, 1200, 1400, 20_000]))
    for begin, end in itertools.pairwise(times):
        now = requests[(requests >> 22 >= begin) & (requests >> 22 < end)]
        parts.append(readout.read_out(now, int(end)))
        assert np.all(parts[-1].keys >> 22 < end)
        assert np.all(parts[-1].periods[:, 0] < end)
    for field in ("keys", "drops_us", "periods"):
        cut = np.concatenate([getattr(part, field) for part in parts])
        assert np.array_equal(cut, getattr(expected, field)), field
    assert (readout.dropped, readout.rate_dropped) == (uncut.dropped, uncut.rate_dropped)
    assert readout.merged == uncut.merged
    lost = uncut.dropped + uncut.rate_dropped + uncut.merged
    assert lost == requests.size - expected.keys.size


def test_the_rate_limit_holds_in_every_period_and_tells_what_it_drops() -> None:
    print(f"seed {SEED}")
    requests = burst(np.random.default_rng(SEED), 20_000, 10_000)
    readout = Readout(720)
    readout.limit(0, EventRate(100, 200))
    out, drops, periods = readout.read_out(requests, 20_000)
    per_period = np.bincount((out >> 22) // 200)
    assert per_period.max() == 100
    assert out.size + readout.rate_dropped + readout.merged == requests.size
    # The readout itself has room for all: it reports no loss.
    assert (readout.dropped, drops.size) == (0, 0)
    ends, came, passed = periods.T
    assert np.array_equal(ends, np.unique((out >> 22) // 200) * 200 + 200)
    assert np.array_equal(passed, np.minimum(came, 100))
    assert came.sum() == requests.size
    assert came.sum() - passed.sum() == readout.rate_dropped


def test_a_new_limit_ends_the_period_under_way() -> None:
    readout = Readout(720)
    readout.limit(0, EventRate(2, 1000))
    early = readout.read_out(keys([100, 101, 102], 5, [1, 2, 3]), 500)
    assert (early.keys.size, early.periods.size) == (2, 0)
    readout.limit(500, EventRate(1, 1000))
    middle = readout.read_out(keys([600, 601], 5, [1, 2]), 900)
    assert middle.periods.tolist() == [[500, 3, 2]]
    assert middle.keys.size == 1
    readout.limit(900, None)
    late = readout.read_out(keys([950, 951], 5, [1, 2]), 5000)
    assert late.periods.tolist() == [[900, 2, 1]]
    assert late.keys.size == 2
    assert readout.rate_dropped == 2


def test_no_rate_at_all_lets_nothing_through() -> None:
    readout = Readout(720)
    readout.limit(0, EventRate(0, 200))
    out, _, periods = readout.read_out(keys([100, 101], 5, [1, 2]), 1000)
    assert out.size == 0
    assert periods.tolist() == [[200, 2, 0]]


def test_a_full_readout_says_so_once_per_millisecond() -> None:
    print(f"seed {SEED}")
    requests = burst(np.random.default_rng(SEED), 20_000, 10_000)
    readout = Readout(720, ReadoutParameters(row_time_us=50.0, waiting_max=300))
    out, drops, _ = readout.read_out(requests, 50_000)
    assert readout.dropped > 1000
    assert np.array_equal(np.unique(drops // 1000), drops // 1000)
    assert out.size + readout.dropped + readout.merged == requests.size


def lit_world(**options) -> World:
    world = World(Plane(1320.0), SMALL, seed=SEED, **options)
    world.set_laser(0, True, Modulation(70.0, on_edge_us=0))
    return world


def test_a_limited_world_tells_in_its_stream_what_it_drops() -> None:
    world = lit_world()
    world.set_sensor(0, SensorControl(event_rate=EventRate(20, 200)))
    decoder = Decoder(96, 720)
    events = decoder.decode(world.advance(200_000))
    counters = decoder.counters
    assert world.rate_dropped > 1000
    assert events.t.size == world.events
    assert np.bincount(events.t // 200).max() == 20
    # The last period is reported when it is over.
    open_period = int(np.count_nonzero(events.t >= 199_800))
    assert counters.erc_events_out == world.events - open_period
    assert counters.erc_events_in - counters.erc_events_out == world.rate_dropped
    assert counters.sensor_drop_words == 0
    free = lit_world()
    free.advance(200_000)
    assert free.rate_dropped == 0
    # Some of the last requests may still wait for their readout.
    assert abs(free.events - world.events - world.rate_dropped) < 50


def test_an_overloaded_world_says_so_in_its_stream() -> None:
    world = lit_world(readout=ReadoutParameters(100.0, waiting_max=200))
    decoder = Decoder(96, 720)
    events = decoder.decode(world.advance(200_000))
    assert world.dropped > 1000
    assert events.t.size == world.events
    assert 10 <= decoder.counters.sensor_drop_words <= 200


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ReadoutParameters(row_time_us=0.0), "row_time_us"),
        (lambda: ReadoutParameters(row_time_us=np.nan), "row_time_us"),
        (lambda: ReadoutParameters(waiting_max=0), "waiting_max"),
        (lambda: EventRate(-1, 1), "events is -1"),
        (lambda: EventRate(1, 0), "period_us is 0"),
    ],
)
def test_impossible_readouts_and_rates_are_refused(make, words) -> None:
    with pytest.raises(ArgumentError, match=words):
        make()
