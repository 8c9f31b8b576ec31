"""Hard case 25: the photoreceptor's closed form for steps far shorter and far longer than it."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest

from eschorty_ros.simulation._pixel_kernels import _crossing_us, _response

SEED = 25
SHORT = np.geomspace(1e-18, 1e-3, 40)
LONG = np.geomspace(1e-3, 1e5, 60)


def relative(ours: float, exact: mpmath.mpf) -> float:
    return float(abs(ours - exact) / abs(exact))


@pytest.mark.parametrize(
    ("u", "settled"), [(1.0, 1 / 6.5), (1 / 6.5, 1.0), (1.0, 0.999), (2.0, 1e-4)]
)
@pytest.mark.parametrize("steps", [SHORT, LONG], ids=["short", "long"])
def test_case_25_step_of_the_photoreceptor(u, settled, steps, measured):
    """``u <- 1/I + (u - 1/I) exp(-x)``, the exponential near 1 or gone."""
    with mpmath.workdps(50):
        worst = 0.0
        for x in steps:
            drop = (mpmath.mpf(u) - mpmath.mpf(settled)) * mpmath.expm1(-mpmath.mpf(float(x)))
            ours = _response(u, settled, float(x))
            worst = max(worst, relative(ours, mpmath.mpf(u) + drop))
    measured("level after a step, relative", worst, 1e-13)


@pytest.mark.parametrize("x", [700.0, 745.2, 1e4, 1e300, np.inf])
def test_case_25_endless_step_settles_exactly(x):
    assert _response(1.0, 0.125, x) == 0.125
    assert _response(0.125, 1.0, x) == 1.0


def test_case_25_many_short_steps_are_one_long_step(measured):
    u = 1.0
    for _ in range(100_000):
        u = _response(u, 0.2, 1e-5)
    measured("100 000 steps against one, relative", relative(u, _response(1.0, 0.2, 1.0)), 1e-11)


@pytest.mark.parametrize("rising", [True, False])
def test_case_25_crossing_time_inverts_the_step(rising, measured):
    """Levels from one part in 1e12 of the swing to all but one part in 1e12 of it."""
    rng = np.random.default_rng(SEED)
    shares = np.concatenate([np.geomspace(1e-12, 0.5, 40), 1.0 - np.geomspace(1e-12, 0.5, 40)])
    tau_us, worst = 159.0, 0.0
    with mpmath.workdps(50):
        for share in shares:
            u, settled = (1.0, rng.uniform(0.01, 0.9)) if rising else (rng.uniform(0.01, 0.9), 1.0)
            level = u + share * (settled - u)
            way = (mpmath.mpf(level) - mpmath.mpf(u)) / (mpmath.mpf(settled) - mpmath.mpf(u))
            if not 0 < way < 1:
                continue
            exact = -mpmath.mpf(tau_us) * mpmath.log1p(-way)
            band = (level, 10.0) if rising else (0.0, level)
            ours = _crossing_us(u, *band, settled, 0.0, tau_us)
            worst = max(worst, relative(ours, exact))
    measured("crossing time, relative", worst, 1e-13)
