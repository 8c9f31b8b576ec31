"""The row arbiter, its limits, and what the stream says of losses."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from eschorty_ros.core.calibration import load_calibration
from eschorty_ros.core.errors import ArgumentError
from eschorty_ros.core.evt3 import Decoder
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.simulation.pixel import unpack
from eschorty_ros.simulation.readout import Readout, ReadoutParameters
from eschorty_ros.simulation.scene import Plane
from eschorty_ros.simulation.world import World

SEED = 4
SMALL = load_calibration("config_3").model_copy(update={"columns": 96, "principal_column": 47.5})


def keys(t, y, x, p=1) -> np.ndarray:
    t, y, x, p = np.broadcast_arrays(t, y, x, p)
    return np.sort(t.astype(np.int64) << 22 | y << 12 | p << 11 | x)


def burst(rng: np.random.Generator, events: int, span_us: int = 400) -> np.ndarray:
    """Events of 20 rows and 100 columns within a short time."""
    return np.unique(
        keys(rng.integers(1000, 1000 + span_us, events), rng.integers(300, 320, events),
             rng.integers(0, 100, events), rng.integers(0, 2, events))
    )  # fmt: skip


def test_a_row_is_read_out_whole_and_rows_wait_for_each_other() -> None:
    readout = Readout(720, ReadoutParameters(row_time_us=10.0))
    requests = keys([100, 101, 103, 100, 104], [5, 5, 5, 9, 9], [1, 2, 3, 4, 5])
    out, drops = readout.read_out(requests, 1000)
    t, x, y, _ = unpack(out)
    # Row 5 asks first and alone; what comes later waits until row 9 is done.
    assert list(zip(t.tolist(), y.tolist(), x.tolist(), strict=True)) == [
        (100, 5, 1), (110, 9, 4), (110, 9, 5), (120, 5, 2), (120, 5, 3),
    ]  # fmt: skip
    assert drops.size == 0


def test_slow_rows_bundle_events_and_lose_none() -> None:
    print(f"seed {SEED}")
    requests = burst(np.random.default_rng(SEED), 3000)
    readout = Readout(720, ReadoutParameters(row_time_us=5.0))
    out, _ = readout.read_out(requests, 10_000)
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
    tight = ReadoutParameters(row_time_us=7.0, waiting_max=300, rate_max_hz=8e5)
    whole = Readout(720, tight)
    expected, expected_drops = whole.read_out(requests, 20_000)
    assert whole.dropped > 100
    parts, drops, readout = [], [], Readout(720, tight)
    times = np.unique(np.append(rng.integers(1000, 6000, 60), [0, 20_000]))
    for begin, end in itertools.pairwise(times):
        now = requests[(requests >> 22 >= begin) & (requests >> 22 < end)]
        out, lost = readout.read_out(now, int(end))
        assert np.all(out >> 22 < end)
        parts.append(out)
        drops.append(lost)
    assert np.array_equal(np.concatenate(parts), expected)
    assert np.array_equal(np.concatenate(drops), expected_drops)
    assert readout.dropped == whole.dropped
    assert readout.merged == whole.merged
    assert whole.dropped + whole.merged == requests.size - expected.size


def test_the_rate_limit_holds_in_every_period() -> None:
    print(f"seed {SEED}")
    requests = burst(np.random.default_rng(SEED), 20_000, 10_000)
    readout = Readout(720, ReadoutParameters(rate_max_hz=5e5))
    out, drops = readout.read_out(requests, 20_000)
    per_period = np.bincount((out >> 22) // 1000)
    assert per_period.max() == 500
    assert out.size + readout.dropped + readout.merged == requests.size
    assert np.array_equal(np.unique(drops // 1000), np.arange(1, 11))


def test_an_overloaded_world_says_so_in_its_stream() -> None:
    limited = ReadoutParameters(rate_max_hz=1e5)
    world = World(Plane(1320.0), SMALL, seed=SEED, readout=limited)
    world.set_laser(0, True, Modulation(70.0, on_edge_us=0))
    decoder = Decoder(96, 720)
    events = decoder.decode(world.advance(200_000))
    assert world.dropped > 1000
    assert events.t.size == world.events
    assert 20 <= decoder.counters.sensor_drop_words <= 200
    free = World(Plane(1320.0), SMALL, seed=SEED)
    free.set_laser(0, True, Modulation(70.0, on_edge_us=0))
    free.advance(200_000)
    assert free.dropped == 0
    # Some of the last requests may still wait for their readout.
    assert abs(free.events - world.events - world.dropped) < 50


@pytest.mark.parametrize(
    ("name", "value"),
    [("row_time_us", 0.0), ("waiting_max", 0), ("rate_max_hz", 10.0), ("rate_max_hz", np.nan)],
)
def test_impossible_readouts_are_refused(name: str, value: float) -> None:
    with pytest.raises(ArgumentError, match=name):
        ReadoutParameters(**{name: value})
