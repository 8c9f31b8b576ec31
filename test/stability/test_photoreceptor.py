"""Hard case 25: photoreceptor and follower for steps far shorter and far longer than they take."""

import mpmath
import numpy as np
import pytest
from from_python import from_python

from eschorty_ros.simulation.pixels._response import (
    NOTHING,
    OFF,
    ON,
    Levels,
    Signal,
    _advanced,
    _noiseless,
)

SEED = 25
advanced, noiseless = from_python(_advanced), from_python(_noiseless)
TAU_US = 159.0
SHORT = np.geomspace(1e-18, 1e-3, 40)
LONG = np.geomspace(1e-3, 1e5, 60)
SWINGS = [(1.0, 1 / 6.5), (1 / 6.5, 1.0), (1.0, 0.999), (2.0, 1e-4)]
swings = pytest.mark.parametrize(("u", "settled"), SWINGS)


def relative(ours: float, exact: mpmath.mpf) -> float:
    return float(abs(ours - exact) / abs(exact))


def exact_levels(u, y, settled, follower_us, t_us):
    """Photoreceptor and follower after ``t_us``; their time constants differ."""
    u, y, settled, t_us = (mpmath.mpf(value) for value in (u, y, settled, t_us))
    fade, lag = mpmath.exp(-t_us / TAU_US), mpmath.exp(-t_us / follower_us)
    a = (u - settled) * TAU_US / (mpmath.mpf(TAU_US) - follower_us)
    return settled + (u - settled) * fade, settled + a * fade + (y - settled - a) * lag


@swings
@pytest.mark.parametrize("steps", [SHORT, LONG], ids=["short", "long"])
@pytest.mark.parametrize("follower_us", [8.0, 1e-3, 600.0])
@pytest.mark.hard_case(25)
def test_step_of_the_photoreceptor(u, settled, steps, follower_us, measured):
    """``u <- 1/I + (u - 1/I) exp(-x)``, the exponential near 1 or gone; the follower behind it."""
    receptor = follower = 0.0
    with mpmath.workdps(50):
        for x in steps:
            t_us = float(x) * TAU_US
            exact_u, exact_y = exact_levels(u, u, settled, follower_us, t_us)
            ours_u, ours_y = advanced(Signal(u, u, settled, TAU_US, follower_us), t_us)
            receptor = max(receptor, relative(ours_u, exact_u))
            follower = max(follower, relative(ours_y, exact_y))
    measured("photoreceptor after a step, relative", receptor, 1e-13)
    measured("follower after a step, relative", follower, 1e-13)


@pytest.mark.parametrize("apart", [0.0, 1e-15, 1e-12, 1e-9, -1e-9, 1e-6, -1e-6, 1e-3, 0.01, -0.1])
@pytest.mark.hard_case(25)
def test_nearly_equal_time_constants(apart, measured):
    """The two exponentials of the follower fall into one, their factors grow without limit."""
    follower_us = TAU_US * (1.0 - apart)
    worst = 0.0
    with mpmath.workdps(50):
        for x in np.geomspace(1e-9, 60.0, 80):
            t_us = float(x) * TAU_US
            if follower_us == TAU_US:
                turns = mpmath.mpf(t_us) / TAU_US
                exact = mpmath.mpf(0.2) + mpmath.mpf(0.8) * mpmath.exp(-turns) * (1 + turns)
            else:
                _, exact = exact_levels(1.0, 1.0, 0.2, follower_us, t_us)
            _, ours = advanced(Signal(1.0, 1.0, 0.2, TAU_US, follower_us), t_us)
            worst = max(worst, relative(ours, exact))
    measured("follower nearly as slow as the photoreceptor, relative", worst, 1e-13)


@pytest.mark.parametrize("t_us", [1e5, 1e9, 1e300])
@pytest.mark.hard_case(25)
def test_endless_step_settles_exactly(t_us):
    assert advanced(Signal(1.0, 0.9, 0.125, TAU_US, 8.0), t_us) == (0.125, 0.125)
    assert advanced(Signal(0.125, 0.2, 1.0, TAU_US, 8.0), t_us) == (1.0, 1.0)


@pytest.mark.hard_case(25)
def test_many_short_steps_are_one_long_step(measured):
    u = y = 1.0
    for _ in range(100_000):
        u, y = advanced(Signal(u, y, 0.2, TAU_US, 8.0), 1e-5 * TAU_US)
    once = advanced(Signal(1.0, 1.0, 0.2, TAU_US, 8.0), TAU_US)
    error = max(relative(a, b) for a, b in zip((u, y), once, strict=True))
    measured("100 000 steps against one, relative", error, 1e-11)


@pytest.mark.parametrize("follower_us", [1e-6, 8.0, 60.0])
@pytest.mark.parametrize("rising", [True, False])
@pytest.mark.hard_case(25)
def test_crossing_is_where_the_step_is_at_the_level(rising, follower_us, measured):
    """Levels from one part in 1e12 of the swing to all but one part in 1e12 of it."""
    rng = np.random.default_rng(SEED)
    shares = np.concatenate([np.geomspace(1e-12, 0.5, 40), 1.0 - np.geomspace(1e-12, 0.5, 40)])
    worst = 0.0
    with mpmath.workdps(50):
        for share in shares:
            u, settled = (1.0, rng.uniform(0.01, 0.9)) if rising else (rng.uniform(0.01, 0.9), 1.0)
            level = u + share * (settled - u)
            band = (level, 10.0) if rising else (0.0, level)
            ours_us, polarity = noiseless(Signal(u, u, settled, TAU_US, follower_us), Levels(*band))
            assert polarity == (ON if rising else OFF)
            _, there = exact_levels(u, u, settled, follower_us, ours_us)
            worst = max(worst, relative(there, mpmath.mpf(level)))
    measured("level at the crossing found, relative", worst, 1e-13)


@pytest.mark.hard_case(25)
def test_level_out_of_reach_is_no_event():
    assert noiseless(Signal(1.0, 1.0, 0.5, TAU_US, 8.0), Levels(0.4, 2.0)) == (np.inf, NOTHING)
    assert noiseless(Signal(1.0, 1.0, 1.0, TAU_US, 8.0), Levels(0.4, 2.0)) == (np.inf, NOTHING)
