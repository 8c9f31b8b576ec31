"""The laser's modulation: accepted ranges and edges that never drift."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from line_events import encoded, line_events
from reconstructing import reconstruct

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.modulation import FREQUENCY_MAX_HZ, FREQUENCY_MIN_HZ, WAVEFORMS, Modulation

EPOCH_US = 1_760_000_000_000_000


@settings(derandomize=True, max_examples=300, deadline=None)
@given(
    st.floats(FREQUENCY_MIN_HZ, FREQUENCY_MAX_HZ),
    st.integers(-(10**10), 10**10),
    st.integers(-EPOCH_US, EPOCH_US),
)
def test_edges_are_the_exact_multiples_to_the_nearest_microsecond(frequency_hz, index, on_edge_us):
    edge = Modulation(frequency_hz, on_edge_us=on_edge_us).edge_us(index)
    assert isinstance(edge, int)
    exact = on_edge_us + index * 10**6 / Fraction(frequency_hz)
    assert abs(edge - exact) <= Fraction(1, 2)


def test_a_day_of_70_hz_does_not_drift():
    modulation = Modulation(70.0, on_edge_us=EPOCH_US)
    assert modulation.edge_us(70 * 86_400) - EPOCH_US == 86_400_000_000
    assert modulation.edge_us(0) == EPOCH_US
    assert [modulation.edge_us(i) - EPOCH_US for i in (1, 2, 7)] == [14286, 28571, 100_000]
    assert modulation.period_us == pytest.approx(14285.714285714286, rel=1e-15)


@pytest.mark.parametrize("frequency_hz", [FREQUENCY_MIN_HZ, 69.99731, FREQUENCY_MAX_HZ])
@pytest.mark.parametrize("waveform", WAVEFORMS)
def test_limits_are_included(frequency_hz, waveform):
    modulation = Modulation(frequency_hz, 0.01, waveform)
    assert modulation.on_edge_us is None
    with pytest.raises(ArgumentError, match="on_edge_us is None"):
        modulation.edge_us(0)


@pytest.mark.parametrize(
    ("frequency_hz", "waveform", "choice"),
    [(20_001.0, "square", "16 to 20000 Hz"), (70.0, "saw", "square, sine")],
)
def test_values_outside_are_refused_with_the_choice(frequency_hz, waveform, choice):
    with pytest.raises(ArgumentError, match=choice):
        Modulation(frequency_hz, waveform=waveform)


def test_equal_settings_are_equal_and_usable_as_keys():
    assert {Modulation(70.0), Modulation(70.0, 0.5, "square")} == {Modulation(70.0)}


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.int16])
def test_numbers_of_numpy_are_taken(kind):
    modulation = Modulation(kind(70), on_edge_us=np.int64(1000))
    assert modulation == Modulation(70.0, on_edge_us=1000)
    data = encoded(line_events(np.random.default_rng(1), lambda k, c: np.full(c.shape, 350.0)))
    assert len(reconstruct(data, modulation)[0]) > 0
