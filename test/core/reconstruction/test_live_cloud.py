"""Points of a live cloud: those of the scan, with times from the stamp."""

import numpy as np
import pytest

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.reconstruction import LIVE_DTYPE, LIVE_SPAN_NS, live_points
from eschorty_ros.core.storage import POINT_DTYPE, REFLECTANCE_DTYPE

STAMP_NS = 1_800_000_000_000_000_000


def points(count, dtype):
    rng = np.random.default_rng(4)
    made = np.zeros(count, dtype)
    for name in dtype.names:
        made[name] = rng.uniform(0, 1000, count)
    return made


@pytest.mark.parametrize("dtype", [POINT_DTYPE, REFLECTANCE_DTYPE])
@pytest.mark.parametrize("count", [0, 1, 1280])
def test_every_field_but_the_time_is_the_scans(dtype, count):
    scan = points(count, dtype)
    since_ns = np.linspace(0, LIVE_SPAN_NS, count, dtype=np.int64)
    live = live_points(scan, STAMP_NS + since_ns, STAMP_NS)
    assert live.dtype.names == dtype.names
    for name in dtype.names:
        np.testing.assert_array_equal(live[name], since_ns if name == "t" else scan[name])
    mirrored = live_points(scan[::-1], STAMP_NS + since_ns[::-1], STAMP_NS)
    np.testing.assert_array_equal(mirrored[::-1], live)


def test_what_is_no_point_or_has_no_time_is_refused():
    scan = points(3, POINT_DTYPE)
    t_ns = np.full(3, STAMP_NS)
    for wrong in (None, np.zeros(3), scan.reshape(3, 1), np.zeros(3, LIVE_DTYPE)):
        with pytest.raises(ArgumentError, match="points"):
            live_points(wrong, t_ns, STAMP_NS)
    for wrong in (t_ns[:2], t_ns.astype(float)):
        with pytest.raises(ArgumentError, match="t_ns"):
            live_points(scan, wrong, STAMP_NS)
