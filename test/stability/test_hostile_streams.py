"""Hard case 26: streams no camera would send end in counted events, never in an exception."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reconstructing import CALIBRATION, assert_events_add_up

from eschorty_ros.core.line import FULL_COLUMN_METHODS, METHODS, RETURNS
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.reconstruction import Profiles, Reconstructor, Settings

WORDS = 6000


def scrambled(seed: int) -> bytes:
    """Words of every kind in any order; rows and columns crowd at a few places, edges included."""
    rng = np.random.default_rng(seed)
    crowd = rng.choice([0, 1, 5, 640, 1279, 1280, 2047], WORDS)
    rows = rng.choice([0, 1, 300, 303, 330, 718, 719, 720, 2047], WORDS)
    high = np.cumsum(rng.choice([0, 0, 0, 1, 1, 7, -1, 200], WORDS))
    kinds = [
        0x8000 | high & 0xFFF,
        0x6000 | rng.integers(0, 4096, WORDS),
        rows,
        0x2000 | crowd | rng.integers(0, 2, WORDS) << 11,
        0x3000 | crowd,
        0x4000 | rng.integers(0, 4096, WORDS),
        0x5000 | rng.integers(0, 256, WORDS),
        rng.integers(0, 1 << 16, WORDS),
    ]
    shares = rng.dirichlet([1.0, 2.0, 4.0, 20.0, 2.0, 2.0, 2.0, 0.1])
    return np.choose(rng.choice(len(kinds), WORDS, p=shares), kinds).astype("<u2").tobytes()


gates_us = 0, 500, 100_000
whole_columns = st.tuples(st.sampled_from(METHODS), st.just("strongest"), st.sampled_from(gates_us))
windows = st.tuples(
    st.sampled_from([name for name in METHODS if name not in FULL_COLUMN_METHODS]),
    st.sampled_from(RETURNS),
    st.sampled_from([-1, *gates_us]),
)
hostile_settings = st.builds(
    lambda method, **others: Settings(*method[:2], phase_gate_us=method[2], **others),
    method=st.one_of(whole_columns, windows),
    noise_filter=st.sampled_from(["none", "activity"]),
    line_width_px=st.sampled_from([1.0, 7.3, 200.0]),
    events_min=st.sampled_from([1, 4]),
    column_limit=st.sampled_from([16, 128]),
    periods_per_profile=st.sampled_from([1, 3]),
)
modulations = st.builds(
    Modulation,
    st.sampled_from([16.0, 69.99731, 20_000.0]),
    on_edge_us=st.sampled_from([None, 0, 123_456, 1 << 40, -(1 << 40)]),
)


@settings(derandomize=True, max_examples=500, deadline=None)
@given(
    st.integers(0, 2**32), st.integers(0, 2 * WORDS), hostile_settings, modulations,
    st.sampled_from(["flush", "gap", "new modulation"]),
)  # fmt: skip
@pytest.mark.hard_case(26)
def test_any_words_are_survived_and_counted(seed, cut, chosen, modulation, between):
    data = scrambled(seed)
    reconstructor = Reconstructor(CALIBRATION, modulation, chosen)
    parts = [reconstructor.push(data[:cut])]
    if between == "flush":
        parts.append(reconstructor.flush())
    elif between == "gap":
        reconstructor.note_gap()
    else:
        reconstructor.set_modulation(Modulation(1000.0))
    parts += [reconstructor.push(data[cut:]), reconstructor.flush()]
    found = Profiles.concatenate(parts)
    assert_events_add_up(reconstructor)
    for name in ("row", "sigma_row", "range_mm", "sigma_mm", "width_px"):
        assert np.isfinite(getattr(found, name)).all(), name
    assert (found.sigma_row > 0.0).all()
    assert (found.range_mm > 0.0).all()
    assert ((found.row >= -0.5) & (found.row <= CALIBRATION.rows - 0.5)).all()
    assert (found.column < CALIBRATION.columns).all()
    assert (found.events >= 1).all()
