"""Integers are sorted as numpy sorts them."""

import numpy as np
import pytest

from eschorty_ros.core.base.sort_keys import sort_keys


@pytest.mark.parametrize("size", [0, 1, 2, 1000, 70_000])
@pytest.mark.parametrize("bits", [0, 1, 9, 43, 63])
def test_keys_are_sorted_as_by_numpy(size, bits):
    print("seed 4")
    keys = np.random.default_rng(4).integers(0, 2**bits, size)
    wanted = np.sort(keys)
    sort_keys(keys)
    np.testing.assert_array_equal(keys, wanted)


def test_digits_that_all_keys_share_are_kept():
    keys = np.array([3, 1, 2, 1]) << 16 | 1 << 40 | 7
    wanted = sorted(keys.tolist())
    sort_keys(keys)
    assert keys.tolist() == wanted
