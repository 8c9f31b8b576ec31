"""Reflectance of single points on uniform columns of known reflectance."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from eschorty_experiments._line_bench import simulate_line
from eschorty_ros.core.base.arrays import Array
from eschorty_ros.core.evt3 import Encoder, sort_readout
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.core.reconstruction import Profiles, Reconstructor, Settings
from eschorty_ros.report.experiment import Effort
from eschorty_ros.simulation.pixels import PixelParameters

FREQUENCIES_HZ = (70.0, 300.0, 1000.0)
BINS = (0.05, 0.1, 0.2, 0.4, 0.7, 1.0)
BACKGROUND_HZ = 0.22
GATE_US = {70.0: 1000, 300.0: 600, 1000.0: 0}
_SETTLED = 2
_PERIODS = 6


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """True and measured reflectance of every point and the standard deviation stated with it."""

    frequency_hz: float
    truth: Array
    reflectance: Array
    sigma: Array

    @property
    def error(self) -> Array:
        """Relative error."""
        return self.reflectance / self.truth - 1.0

    @property
    def pull(self) -> Array:
        """Error over its stated standard deviation."""
        return (self.reflectance - self.truth) / self.sigma


def measure_reflectance(
    parameters: PixelParameters, frequency_hz: float, effort: Effort
) -> Measured:
    """Measure columns of log-uniform reflectance, relative to a white target in the same setup."""
    columns = effort.choose(1024, 320)
    rng = np.random.default_rng(effort.seed)
    truth = np.exp(rng.uniform(np.log(BINS[0]), 0.0, columns))
    settings = Settings(
        reflectance="on",
        phase_gate_us=GATE_US[frequency_hz],
        smoothing_half_width=0,
        isolation_events=0,
    )
    white = _points(parameters, frequency_hz, np.ones(columns), effort.seed, settings)
    settings = replace(settings, white_width_px=float(np.median(white.width_px)))
    found = _points(parameters, frequency_hz, truth, effort.seed + 1, settings)
    assert found.reflectance is not None
    assert found.reflectance_sigma is not None
    return Measured(frequency_hz, truth[found.column], found.reflectance, found.reflectance_sigma)


def summarise(measured: Measured) -> list[list[float]]:
    """Return by range of reflectance: median error, scatter (68 %), sigma, shares within it."""
    rows = []
    for low, high in pairwise(BINS):
        inside = (measured.truth >= low) & (measured.truth < high)
        if not inside.any():
            continue
        error, pull = measured.error[inside], np.abs(measured.pull[inside])
        middle = float(np.median(error))
        rows.append([
            measured.frequency_hz, low, high, middle,
            float(np.quantile(np.abs(error - middle), 0.6827)),
            float(np.median(measured.sigma[inside] / measured.truth[inside])),
            float(np.mean(pull < 1.0)), float(np.mean(pull < 2.0)),
        ])  # fmt: skip
    return rows


def _points(
    parameters: PixelParameters,
    frequency_hz: float,
    reflectance: Array,
    seed: int,
    settings: Settings,
) -> Profiles:
    columns = reflectance.size
    modulation = Modulation(frequency_hz, on_edge_us=0)
    line = simulate_line(
        parameters,
        modulation,
        modulation.edge_us(_PERIODS),
        columns=columns,
        line_row=360.0 + np.random.default_rng(seed).random(columns),
        reflectance=reflectance,
        background_hz=BACKGROUND_HZ,
        seed=seed,
    )
    calibration = replace(load_calibration("config_3"), columns=columns)
    data = Encoder(columns, calibration.rows).encode(*sort_readout(line.t, line.x, line.y, line.p))
    reconstructor = Reconstructor(calibration, modulation, settings)
    found = Profiles.concatenate([reconstructor.push(data), reconstructor.flush()])
    return found.select(found.period >= _SETTLED)
