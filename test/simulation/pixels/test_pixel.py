"""The pixel model against its closed forms."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.simulation.pixels import PixelArray, PixelParameters, unpack
from eschorty_ros.simulation.pixels._response import OFF, ON

SEED = 7
CENTRE = 40.0
ROWS = 81
CLEAN = {
    "threshold_mismatch": 0.0, "follower_hz": math.inf, "noise": 0.0, "latency_us": 0.0,
    "latency_jitter_us": 0.0,
}  # fmt: skip
"""Nothing but photoreceptor, comparator and refractory time."""


def flash(
    pixels: PixelArray, frequency_hz: float, seconds: float, row: float = CENTRE
) -> tuple[np.ndarray, ...]:
    """Events of a square wave of duty 1/2 on all columns: t, x, y, p."""
    columns = np.arange(pixels.columns)
    line = np.full(pixels.columns, row)
    half_us = 5e5 / frequency_hz
    for k in range(round(2 * frequency_hz * seconds)):
        pixels.relight(round(k * half_us), columns, line, np.full(pixels.columns, 1.0 - k % 2))
    end_us = round(2 * frequency_hz * seconds) * half_us
    pixels.run_until(round(end_us))
    return unpack(pixels.take(round(end_us)))


def closed_form(
    frequency_hz: float, rows: np.ndarray, p: PixelParameters
) -> tuple[np.ndarray, ...]:
    """Steady u at the end of the bright and of the dark half, per row."""
    intensity = 1.0 + p.amplitude * np.exp(-0.5 * ((rows - CENTRE) / p.sigma_rows) ** 2)
    omega = 2.0 * math.pi * p.bandwidth_hz
    a = np.exp(-omega * intensity / (2.0 * frequency_hz))
    c = np.exp(-omega / (2.0 * frequency_hz))
    bright = ((1.0 - a) / intensity + a * (1.0 - c)) / (1.0 - a * c)
    dark = ((1.0 - c) + c * (1.0 - a) / intensity) / (1.0 - a * c)
    return bright, dark


@pytest.mark.parametrize("frequency_hz", [70.0, 1000.0, 10_000.0])
def test_photoreceptor_swings_as_the_closed_form_says(frequency_hz: float) -> None:
    # Thresholds out of reach; the mismatch only sets how faint a row is still drawn.
    blind = PixelParameters(
        threshold_on=20.0, threshold_off=20.0, threshold_min=0.25, threshold_mismatch=0.25
    )
    pixels = PixelArray(1, ROWS, blind, SEED)
    column, line = np.array([0]), np.array([CENTRE])
    half_us = round(5e5 / frequency_hz)
    actual_hz = 5e5 / half_us
    rows = np.arange(29, 52)
    edges = 2 * math.ceil(40_000 / half_us)
    for k in range(edges):
        pixels.relight(k * half_us, column, line, np.array([1.0 - k % 2]))
    pixels.relight(edges * half_us, column, line, np.array([1.0]))
    dark_u = pixels._pixels["u"][0, rows].copy()
    pixels.relight((edges + 1) * half_us, column, line, np.array([0.0]))
    bright_u = pixels._pixels["u"][0, rows]
    bright, dark = closed_form(actual_hz, rows, blind)
    state = pixels._columns[0]
    inside = (rows >= state["due_begin"]) & (rows < state["due_end"])
    assert inside.sum() >= 15
    assert np.max(np.abs(bright_u / bright - 1.0)[inside]) < 1e-12
    assert np.max(np.abs(dark_u / dark - 1.0)[inside]) < 1e-12


def test_first_events_come_at_the_crossing_times() -> None:
    exact = PixelParameters(**CLEAN)
    t, x, y, p = flash(PixelArray(1, ROWS, exact, SEED), 70.0, 1 / 70)
    assert not x.any()
    half_us = 5e5 / 70
    omega = exact.omega_per_us
    for row in np.unique(y):
        intensity = 1.0 + 5.5 * math.exp(-0.5 * ((row - CENTRE) / 4.1) ** 2)
        on_us = -math.log((math.exp(-0.25) - 1 / intensity) / (1 - 1 / intensity))
        on_us /= omega * intensity
        # The reference is re-sampled 0.7 ms after the event; the fall starts from 1 / I.
        settle = math.exp(-omega * intensity * (0.7e3 + on_us))
        reference = 1 / intensity + (1 - 1 / intensity) * settle
        bright = 1 / intensity
        off_us = -math.log((reference * math.exp(0.25) - 1) / (bright - 1)) / omega
        here = y == row
        assert p[here].tolist() == [1, 0], row
        # A request takes at least 1 us and is read out at the next whole microsecond.
        assert 1.0 <= t[here][0] - on_us <= 2.001
        assert 1.0 <= t[here][1] - round(half_us) - off_us <= 2.001


def test_line_is_20_rows_wide_and_gives_40_events_a_period() -> None:
    quiet = PixelParameters(noise=0.0)
    t, _, y, p = flash(PixelArray(64, ROWS, quiet, SEED), 70.0, 0.5)
    per_row = np.bincount(y, minlength=ROWS) / 64 / 35
    plateau = np.sort(per_row)[-3:].mean()
    assert plateau == pytest.approx(2.0, abs=0.02)
    assert (per_row >= 0.5 * plateau).sum() in (19, 20, 21)
    width = per_row.sum() / plateau
    closed = 2 * 4.1 * math.sqrt(2 * math.log(5.5 / math.expm1(0.25)))
    # A marginal pixel fires only when both of its thresholds are low: a little narrower.
    assert closed - 0.8 < width < closed + 0.1
    assert p.mean() == pytest.approx(0.5, abs=0.01)
    assert t.min() > 0


@pytest.mark.parametrize("frequency_hz", [500.0, 4000.0, 12_000.0])
def test_rows_fire_where_the_closed_form_swing_exceeds_the_threshold(frequency_hz: float) -> None:
    quick = PixelParameters(**CLEAN | {"refractory_us": 1.0})
    t, _, y, _ = flash(PixelArray(1, ROWS, quick, SEED), frequency_hz, 0.05)
    settled = t > 30_000
    fired = np.zeros(ROWS, dtype=bool)
    fired[np.unique(y[settled])] = True
    bright, dark = closed_form(frequency_hz, np.arange(ROWS), quick)
    swing = np.log(dark / bright)
    assert (swing > 0.55).sum() >= 3
    # Between one and two thresholds it depends on where the reference came to rest.
    assert fired[swing > 0.5 + 0.02].all()
    assert not fired[swing < 0.25 - 0.02].any()


def test_no_pixel_fires_within_its_refractory_time() -> None:
    prompt = PixelParameters(latency_us=0.0, latency_jitter_us=0.0)
    t, x, y, _ = flash(PixelArray(16, ROWS, prompt, SEED), 900.0, 0.1)
    pixel = x.astype(np.int64) * ROWS + y
    order = np.lexsort((t, pixel))
    same = np.diff(pixel[order]) == 0
    assert np.diff(t[order])[same].min() >= 699


def test_latency_has_the_promised_mean_and_jitter() -> None:
    def central_us(**latency: float) -> np.ndarray:
        parameters = PixelParameters(**CLEAN | latency)
        t, _, y, _ = flash(PixelArray(1280, ROWS, parameters, SEED), 70.0, 1 / 140)
        return t[y == 40]

    late = central_us(latency_us=100.0, latency_jitter_us=30.0) - central_us().mean() + 1.0
    assert late.size == 1280
    assert late.mean() == pytest.approx(100.0, abs=3.0)
    assert late.std() == pytest.approx(30.0, abs=2.0)


def test_row_position_is_found_between_rows() -> None:
    error = []
    for k, offset in enumerate(np.linspace(0.0, 1.0, 21)):
        # Other thresholds every time: they shift the line by a fixed pattern.
        pixels = PixelArray(64, ROWS, PixelParameters(), SEED + k)
        _, _, y, _ = flash(pixels, 70.0, 0.05, 40.0 + offset)
        error.append(y.mean() - 40.0 - offset)
    # Whole rows fire or not: a quarter row at worst for one position, nothing on average.
    assert np.max(np.abs(error)) < 0.3
    assert abs(np.mean(error)) < 0.03


def quiet_events(
    p: PixelParameters, offset: float, edges_us: list[int], end_us: int
) -> list[tuple[float, int]]:
    """Time and polarity of the events of a pixel without noise whose light changes at the edges."""
    bright = p.background_intensity + p.amplitude * math.exp(-0.5 * (offset / p.sigma_rows) ** 2)
    state, reference, held_us, events = [1.0, 1.0], 1.0, 0.0, []
    for k, begin_us in enumerate(edges_us):
        intensity = p.background_intensity if k % 2 else bright
        rate = p.omega_per_us * intensity

        def slopes(_, s, rate=rate, intensity=intensity):
            return [(1.0 / intensity - s[0]) * rate, (s[0] - s[1]) / p.follower_us]

        now_us, stop_us = float(begin_us), edges_us[k + 1] if k + 1 < len(edges_us) else end_us
        while now_us < stop_us:
            waits = now_us >= held_us
            on, off = reference * math.exp(-p.threshold_on), reference * math.exp(p.threshold_off)
            levels = [lambda _, s, on=on: s[1] - on, lambda _, s, off=off: s[1] - off]
            for level in levels:
                level.terminal = True
            until_us = stop_us if waits else min(held_us, stop_us)
            path = solve_ivp(
                slopes, (now_us, until_us), state, "DOP853", rtol=1e-11, atol=1e-13,
                events=levels if waits else None,
            )  # fmt: skip
            state, now_us = path.y[:, -1], path.t[-1]
            if now_us == held_us:
                reference = state[1]
            if path.status == 1:
                events.append((now_us, ON if path.t_events[0].size else OFF))
                held_us = now_us + p.refractory_us
    return events


@pytest.mark.parametrize("follower_hz", [1000.0, 20_000.0])
def test_events_of_a_flashing_line_come_when_an_integrator_says(follower_hz: float) -> None:
    quiet = PixelParameters(**(CLEAN | {"follower_hz": follower_hz}))
    edges_us, end_us = [0, 1300, 4100, 5000, 7700, 8000, 8300], 20_000
    pixels = PixelArray(1, ROWS, quiet, SEED)
    for k, t_us in enumerate(edges_us):
        pixels.relight(t_us, np.array([0]), np.array([CENTRE]), np.array([1.0 - k % 2]))
    pixels.run_until(end_us)
    t, _, y, p = unpack(pixels.take(end_us))
    for row in (40, 44, 47, 48):
        wanted = quiet_events(quiet, row - CENTRE, edges_us, end_us)
        mine = sorted(zip(t[y == row].tolist(), p[y == row].tolist(), strict=True))
        assert [what for _, what in mine] == [what for _, what in wanted]
        # A request takes 1 us and is read out at the next whole microsecond.
        late_us = np.array([t for t, _ in mine]) - np.array([t for t, _ in wanted])
        assert np.all((late_us >= 1.0 - 1e-6) & (late_us <= 2.0 + 1e-6)), row


@pytest.mark.parametrize("noise", [0.0, 0.04])
def test_looking_in_between_changes_nothing(noise: float) -> None:
    looked_at, left_alone = (PixelArray(8, ROWS, PixelParameters(noise=noise), SEED) for _ in "ab")
    column, line = np.arange(8), np.full(8, CENTRE)
    for k in range(14):
        for array in (looked_at, left_alone):
            array.relight(k * 7143, column, line, np.full(8, 1.0 - k % 2))
        for t_us in range(k * 7143, (k + 1) * 7143, 97):
            looked_at.run_until(t_us)
    for array in (looked_at, left_alone):
        array.run_until(200_000)
    keys = looked_at.take(200_000)
    assert keys.size > 1000
    assert np.array_equal(keys, left_alone.take(200_000))


def test_dark_columns_make_no_events_and_stay_untouched() -> None:
    pixels = PixelArray(8, ROWS, PixelParameters(), SEED)
    before = pixels._pixels.copy()
    columns = np.arange(8)
    for k in range(20):
        pixels.relight(k * 7000, columns, np.full(8, np.nan), np.ones(8))
        pixels.run_until(k * 7000 + 6999)
    assert pixels.take(10**6).size == 0
    assert np.array_equal(pixels._pixels, before)


def test_a_jumping_line_leaves_the_old_rows_and_lights_the_new() -> None:
    pixels = PixelArray(1, 200, PixelParameters(noise=0.0), SEED)
    column, full = np.array([0]), np.array([1.0])
    for t_us, row in ((0, 50.0), (5000, 150.0), (10_000, 52.0), (15_000, np.nan)):
        pixels.relight(t_us, column, np.array([row]), full)
    pixels.run_until(25_000)
    t, _, y, p = unpack(pixels.take(25_000))
    late = (t > 5000) & (t < 10_000)
    assert set(p[late & (y < 100)]) == {0}
    assert set(p[late & (y > 100)]) == {1}
    assert set(p[(t > 15_000) & (y < 100)]) == {0}
    assert np.isinf(pixels._columns["due_us"]).all()


def test_output_grows_when_it_must() -> None:
    # Tiny thresholds and no refractory time: dozens of events per pixel and edge.
    eager = PixelParameters(threshold_on=0.03, threshold_off=0.03, refractory_us=1.0, noise=0.0)
    small, large = (PixelArray(64, ROWS, eager, SEED, 50.0) for _ in range(2))
    large._keys = np.empty(1 << 22, dtype=np.int64)
    small._keys = np.empty(16, dtype=np.int64)
    events = flash(small, 70.0, 0.1)
    assert all(np.array_equal(*pair) for pair in zip(events, flash(large, 70.0, 0.1), strict=True))
    assert events[0].size > 300_000


@pytest.mark.parametrize(
    ("name", "value"),
    [("sigma_rows", 0.0), ("threshold_on", -0.1), ("amplitude", math.nan), ("refractory_us", 0.5),
     ("latency_us", -1.0), ("noise", -0.1), ("follower_hz", math.nan)],
)  # fmt: skip
def test_impossible_parameters_are_refused(name: str, value: float) -> None:
    with pytest.raises(ArgumentError, match=name):
        PixelParameters(**{name: value})


def test_impossible_arrays_are_refused() -> None:
    with pytest.raises(ArgumentError, match="2048 x 1024"):
        PixelArray(4096, 10, PixelParameters())
    with pytest.raises(ArgumentError, match="background_hz"):
        PixelArray(8, 8, PixelParameters(), background_hz=-1.0)
    with pytest.raises(ArgumentError, match="reflectance"):
        PixelArray(8, 8, PixelParameters()).relight(0, np.array([0]), np.ones(1), np.full(1, 2.0))
