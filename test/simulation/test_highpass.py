"""The high-pass of the event pixels: its closed form against fine steps, and what it does."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pixel_reference import integrated, stepped

from eschorty_ros.core.modulation import Modulation
from eschorty_ros.simulation._highpass_kernels import _forgotten, _noiseless_highpass
from eschorty_ros.simulation._response_kernels import NOTHING, _advanced
from eschorty_ros.simulation.line_bench import LineEvents, simulate_line
from eschorty_ros.simulation.pixel import PixelArray, PixelParameters, unpack

SEED = 11
ROWS, CENTRE = 81, 40.0
TAU_US = 159.0
QUIET = {
    "threshold_mismatch": 0.0,
    "noise": 0.0,
    "latency_us": 0.0,
    "latency_jitter_us": 0.0,
}


def bench(parameters: PixelParameters, frequency_hz: float, seconds: float, columns: int = 48):
    print(f"seed {SEED}")
    return simulate_line(
        parameters, Modulation(frequency_hz), round(seconds * 1e6), columns=columns,
        line_row=CENTRE, rows=ROWS, seed=SEED,
    )  # fmt: skip


def rows_lit(events: LineEvents) -> int:
    """Rows between the first and last at half of the mean of the three highest."""
    counts = np.bincount(events.y, minlength=ROWS)
    wide = np.flatnonzero(counts >= 0.5 * np.sort(counts)[-3:].mean())
    return int(wide[-1] - wide[0] + 1)


# Follower and high-pass as shares of the photoreceptor's time constant.
@pytest.mark.parametrize(
    ("follower", "highpass"),
    [
        (0.05, 10.0),
        (0.05, 1e7),
        (0.05, 0.05),
        (0.05, 0.05 * (1.0 + 1e-9)),
        (0.05, 1.0),
        (1.0, 1.0),
        (1.0, 1.0 - 1e-7),
        (1.0, 0.05),
        (1.001, 0.999),
        (1e-3, 1.0),
        (0.3, 1e-3),
        (4.0, 0.5),
        (2.0, 6.0),
    ],
)
def test_passages_and_states_agree_with_fine_steps(follower: float, highpass: float) -> None:
    rng = np.random.default_rng(SEED)
    print(f"seed {SEED}")
    follower_us, highpass_us = follower * TAU_US, highpass * TAU_US
    rates = (1.0 / TAU_US, 1.0 / follower_us, 1.0 / highpass_us)
    dt_us = min(TAU_US, follower_us, highpass_us) / 100.0
    # After the two others have settled the reference only draws nearer.
    until_us = 12.0 * TAU_US + 12.0 * follower_us + min(4.0 * highpass_us, 8.0 * TAU_US)
    found = []
    for _ in range(40 if dt_us > 1.0 else 12):
        reference, settled = rng.uniform(0.15, 1.0, 2)
        # u anywhere: the signal may turn round on its way, and the reference after it.
        u = rng.uniform(0.15, 1.0)
        theta = np.exp(rng.uniform(math.log(1e-4), math.log(0.4), 2))
        factors = math.exp(-theta[0]), math.exp(theta[1])
        y = reference * rng.uniform(factors[0], factors[1])
        model = settled, TAU_US, follower_us
        t_us, state, what = integrated((u, y, reference), settled, rates, factors, until_us, dt_us)
        mine_us, mine = _noiseless_highpass(u, y, reference, *model, highpass_us, *factors)
        assert mine == what
        if what != NOTHING:
            assert mine_us == pytest.approx(t_us, rel=1e-7, abs=1e-9)
        assert _forgotten(u, y, reference, *model, highpass_us, t_us) == pytest.approx(
            state[2], rel=1e-9
        )
        assert _advanced(u, y, *model, t_us) == pytest.approx(state[:2], rel=1e-9)
        found.append(what)
    assert len(set(found)) > 1


def test_a_signal_that_only_touches_the_level_passes_it() -> None:
    settled, model = 0.5, (0.5, TAU_US, 8.0, 400.0)
    u = y = reference = 1.0
    deepest = 1.0
    for t_us in np.arange(0.0, 2000.0, 0.05):
        there = _advanced(u, y, settled, TAU_US, 8.0, t_us)[1]
        deepest = min(deepest, there / _forgotten(u, y, reference, *model, t_us))
    assert _noiseless_highpass(u, y, reference, *model, deepest * (1.0 + 1e-6), 2.0)[1] == 1
    assert _noiseless_highpass(u, y, reference, *model, deepest * (1.0 - 1e-6), 2.0) == (
        math.inf,
        NOTHING,
    )


def chain(p: PixelParameters, offset: float, edges_us: list[int], end_us: int) -> list[tuple]:
    """Events (time, polarity) of a quiet pixel under light that changes at the edges, by steps."""
    bright = p.background_intensity + p.amplitude * math.exp(-0.5 * (offset / p.sigma_rows) ** 2)
    factors = math.exp(-p.threshold_on), math.exp(p.threshold_off)
    state, held_us, events = (1.0, 1.0, 1.0), 0.0, []
    for k, begin_us in enumerate(edges_us):
        intensity = bright if k % 2 == 0 else p.background_intensity
        rates = (p.omega_per_us * intensity, 1.0 / p.follower_us, 1.0 / p.highpass_us)
        stop_us = edges_us[k + 1] if k + 1 < len(edges_us) else end_us
        now_us = float(begin_us)
        while now_us < stop_us:
            waits = now_us >= held_us
            until_us = stop_us if waits else min(held_us, stop_us)
            within = factors if waits else (0.0, math.inf)
            spent_us, state, what = integrated(
                state, 1.0 / intensity, rates, within, until_us - now_us, 0.1
            )
            now_us = until_us if what == NOTHING else now_us + spent_us
            if not waits and now_us == held_us:
                state = (state[0], state[1], state[1])
            if what != NOTHING:
                events.append((now_us, what))
                held_us = now_us + p.refractory_us
    return events


@pytest.mark.parametrize(
    ("highpass_hz", "follower_hz"), [(50.0, 20_000.0), (1000.0, 1000.0), (300.0, 20_000.0)]
)
def test_events_of_a_flashing_line_come_when_fine_steps_say(highpass_hz, follower_hz) -> None:
    quiet = PixelParameters(**QUIET, highpass_hz=highpass_hz, follower_hz=follower_hz)
    edges_us, end_us = [0, 1300, 4100, 5000, 7700, 8000, 8300], 20_000
    pixels = PixelArray(1, ROWS, quiet, SEED)
    for k, t_us in enumerate(edges_us):
        pixels.relight(t_us, np.array([0]), np.array([CENTRE]), np.array([1.0 - k % 2]))
    pixels.run_until(end_us)
    t, _, y, p = unpack(pixels.take(end_us))
    for row in (40, 44, 47, 48):
        wanted = chain(quiet, row - CENTRE, edges_us, end_us)
        mine = sorted(zip(t[y == row].tolist(), p[y == row].tolist(), strict=True))
        assert [what for _, what in mine] == [what for _, what in wanted]
        # A request takes 1 us and is read out at the next whole microsecond.
        late = np.array([t for t, _ in mine]) - np.array([t for t, _ in wanted])
        assert np.all((late >= 1.0 - 1e-6) & (late <= 2.0 + 1e-6)), row


@pytest.mark.parametrize(
    ("frequency_hz", "seconds", "highpass_hz"),
    [(70.0, 0.1, 300.0), (500.0, 0.04, 100.0), (1000.0, 0.04, 1000.0), (5000.0, 0.03, 1000.0)],
)
def test_noisy_counts_and_widths_agree_with_fine_time_steps(
    frequency_hz: float, seconds: float, highpass_hz: float
) -> None:
    pixels = PixelParameters(highpass_hz=highpass_hz)
    near = np.arange(26, 55)
    reference = stepped(pixels, frequency_hz, seconds, np.tile(near - CENTRE, 12), SEED)
    per_row = np.bincount(26 + reference[:, 1].astype(np.int64) % near.size, minlength=ROWS) / 12
    events = bench(pixels, frequency_hz, seconds, columns=64)
    print(len(events) / 64, per_row.sum())
    assert len(events) / 64 == pytest.approx(per_row.sum(), rel=0.05)
    wide = np.flatnonzero(per_row >= 0.5 * np.sort(per_row)[-3:].mean())
    assert abs(rows_lit(events) - (wide[-1] - wide[0] + 1)) <= 1
    # From 1 kHz on a pixel answers some edges only; which, hangs on the steps of the reference: a
    # quarter of a microsecond instead of one shifts the polarities by 0.05, the counts hardly.
    if frequency_hz < 1000.0:
        assert events.p.mean() == pytest.approx(reference[:, 2].mean(), abs=0.03)


def test_a_slow_line_narrows_and_loses_its_tail_a_fast_one_hardly_changes() -> None:
    poles_hz = (0.0, 30.0, 100.0, 300.0, 1000.0)
    slow = [bench(PixelParameters(highpass_hz=f), 70.0, 0.1) for f in poles_hz]
    counts = [len(events) for events in slow]
    widths = [float(np.std(events.y)) for events in slow]
    late = [int(np.sum(events.t % round(5e5 / 70.0) > 600)) for events in slow]
    fast = [len(bench(PixelParameters(highpass_hz=f), 5000.0, 0.03)) for f in poles_hz]
    print(counts, widths, late, fast)
    assert counts == sorted(counts, reverse=True)
    assert widths == sorted(widths, reverse=True)
    assert late == sorted(late, reverse=True)
    assert counts[-1] < 0.85 * counts[0]
    assert rows_lit(slow[-1]) <= rows_lit(slow[0]) - 3
    assert late[-1] < 0.1 * late[0]
    assert min(fast) > 0.9 * fast[0]


def test_an_endlessly_slow_filter_is_none() -> None:
    plain, slow = PixelParameters(**QUIET), PixelParameters(**QUIET, highpass_hz=1e-9)
    for frequency_hz in (70.0, 3000.0):
        without, behind = (bench(p, frequency_hz, 0.03, columns=4) for p in (plain, slow))
        assert len(without) > 100
        for name in ("t", "x", "y", "p"):
            assert np.array_equal(getattr(without, name), getattr(behind, name))


@pytest.mark.parametrize("noise", [0.0, 0.04])
def test_looking_in_between_changes_nothing_and_the_dark_costs_nothing(noise: float) -> None:
    pixels = PixelParameters(noise=noise, highpass_hz=100.0)
    looked_at, left_alone = (PixelArray(8, ROWS, pixels, SEED) for _ in range(2))
    column, line = np.arange(8), np.full(8, CENTRE)
    for k in range(14):
        for array in (looked_at, left_alone):
            array.relight(k * 7143, column, line, np.full(8, 1.0 - k % 2))
        for t_us in range(k * 7143, (k + 1) * 7143, 97):
            looked_at.run_until(t_us)
    for array in (looked_at, left_alone):
        array.run_until(200_000)
        # Nothing is left to come to, in no pixel.
        assert np.isinf(array._due).all()
    keys = looked_at.take(200_000)
    assert keys.size > 1000
    assert np.array_equal(keys, left_alone.take(200_000))


def test_a_leak_is_drawn_back_before_it_makes_an_event() -> None:
    def rate_hz(highpass_hz: float) -> float:
        leaky = PixelParameters(leak_hz=5.0, highpass_hz=highpass_hz)
        events = simulate_line(
            leaky, Modulation(70.0), 200_000, columns=64, reflectance=0.0, rows=ROWS, seed=SEED
        )
        return len(events) / (64 * ROWS * 0.2)

    # The reference strays by (leak / pole) (1 - exp(-pole t)) thresholds.
    pole = 2.0 * math.pi * 0.6
    expected = -pole / math.log(1.0 - pole / 5.0)
    assert rate_hz(0.6) == pytest.approx(expected, rel=0.1)
    assert rate_hz(0.0) == pytest.approx(5.0, rel=0.1)
    assert rate_hz(1.0) == 0.0
