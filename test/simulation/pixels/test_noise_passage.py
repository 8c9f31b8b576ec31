"""When a noisy pixel passes its threshold: looked up, against the risk summed in fine steps."""

import math

import numpy as np
import pytest
from from_python import from_python

from eschorty_ros.simulation.pixels._passage import GAP_MAX, GAP_MIN, GAP_STEPS, noise_table
from eschorty_ros.simulation.pixels._prompt import _prompt, passage_gaps, way_times
from eschorty_ros.simulation.pixels._response import OFF, ON, UNKNOWN, Levels, Signal

TAU_DARK_US, THRESHOLD = 159.15, 0.25
DRAWS = (np.arange(400) + 0.5) / 400
prompt = from_python(_prompt)


def summed(u: float, settled: float, follower_us: float, noise: float, dt_us: float) -> np.ndarray:
    """Time of the passage per draw, us: the risk of the noise table in steps of ``dt_us``."""
    tau_us = TAU_DARK_US * settled
    t = np.arange(0.0, 12.0 * tau_us, dt_us)
    fast, slow = np.exp(-t / follower_us), np.exp(-t / tau_us)
    y = settled + (u - settled) * (tau_us * slow - follower_us * fast) / (tau_us - follower_us)
    gap = (THRESHOLD - np.abs(np.log(y / u))) / noise
    table = noise_table(follower_us)
    at = GAP_MIN + np.arange(len(table)) / GAP_STEPS
    rate, share = (np.interp(np.clip(gap, GAP_MIN, GAP_MAX), at, table[:, k]) for k in (0, 2))
    passed, frozen = rate[1:] * dt_us, np.maximum(np.diff(share), 0.0)
    risk = np.cumsum(np.maximum(passed, frozen) + 0.6 * np.minimum(passed, frozen))
    return np.interp(-np.log(DRAWS), risk, t[1:])


@pytest.mark.parametrize("light", [6.5, 3.6, 1.8])
@pytest.mark.parametrize(("follower_us", "noise"), [(7.96, 0.04), (4.8, 0.01)])
@pytest.mark.parametrize("rising", [True, False])
def test_time_of_the_passage_agrees_with_the_summed_risk(light, follower_us, noise, rising):
    u, settled = (1.0, 1.0 / light) if rising else (1.0 / light, 1.0)
    gaps = passage_gaps(noise_table(follower_us), follower_us)
    levels = Levels(u * math.exp(-THRESHOLD), u * math.exp(THRESHOLD))
    signal = Signal(u, u, settled, TAU_DARK_US * settled, follower_us)
    found = [prompt(signal, levels, noise, way_times(), gaps, draw) for draw in DRAWS]
    assert {what for _, what in found} == {ON if rising else OFF}
    t_us = np.array([after_us for after_us, _ in found])
    wanted = summed(u, settled, follower_us, noise, 0.02)
    print(np.median(t_us) - np.median(wanted), t_us.std() / wanted.std() - 1.0)
    assert abs(np.median(t_us) - np.median(wanted)) < 0.1 * wanted.std()
    assert t_us.std() == pytest.approx(wanted.std(), rel=0.1)


def test_levels_the_signal_hardly_reaches_are_not_looked_up():
    gaps = passage_gaps(noise_table(8.0), 8.0)
    for light in (1.0, 1.05, 1.29):
        signal = Signal(1.0, 1.0, 1.0 / light, TAU_DARK_US / light, 8.0)
        after_us, what = prompt(signal, Levels(0.78, 1.28), 0.04, way_times(), gaps, 0.5)
        assert (after_us, what) == (math.inf, UNKNOWN)
