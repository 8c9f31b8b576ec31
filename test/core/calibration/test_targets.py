"""Targets: what is accepted, what is refused, and joining them."""

import numpy as np
import pytest

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.calibration import SIGMA_ROW_PX, Targets


def test_one_number_stands_for_all_targets():
    targets = Targets([10, 20.5], [800, 900.0], sigma_range_mm=[0.0, 1.0], size_mm=25.4, width_px=9)
    assert len(targets) == 2
    assert targets.row.dtype == targets.range_mm.dtype == np.float64
    assert targets.sigma_row_px.tolist() == [SIGMA_ROW_PX] * 2
    assert np.isnan(targets.column).all()
    assert (targets.labels, targets.lateral) == (("1", "2"), 2)
    assert Targets([1.0], [800.0], width_px=9.0, spacing_mm=5.0).lateral == 0
    with pytest.raises(ValueError, match="read-only"):
        targets.row[0] = 1.0


def test_parts_are_joined_and_selected_with_their_labels():
    a = Targets([1.0, 2.0], [800.0, 900.0], labels=("near", "far"))
    b = Targets([3.0], [1000.0], spacing_px=100.0, spacing_mm=25.0)
    both = Targets.concatenate([a, b])
    assert both.labels == ("near", "far", "1")
    assert both.row.tolist() == [1.0, 2.0, 3.0]
    assert both.has_spacing.tolist() == [False, False, True]
    kept = both.select([False, True, True])
    assert (kept.labels, kept.range_mm.tolist()) == (("far", "1"), [900.0, 1000.0])
    assert len(both.select([2, 0])) == 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"row": [1.0, np.nan]}, "row of target far is nan; give a finite number"),
        ({"row": [1.0]}, r"range_mm has shape \(2,\); give one number or 1"),
        ({"row": [[1.0, 2.0]]}, r"row has shape \(1, 2\)"),
        ({"row": ["a", "b"]}, "row has dtype"),
        ({"range_mm": [800.0, 0.0]}, "range_mm of target far is 0; choose a positive range"),
        ({"range_mm": [800.0, np.inf]}, "range_mm of target far is inf"),
        ({"sigma_row_px": 0.0}, "sigma_row_px of target near is 0"),
        ({"sigma_range_mm": -1.0}, "sigma_range_mm of target near is -1; choose 0 or more"),
        ({"sigma_shared_mm": -1.0}, "sigma_shared_mm of target near is -1; choose 0 or more"),
        ({"column": np.inf}, "column of target near is inf"),
        ({"size_mm": -1.0}, "size_mm of target near is -1; choose a positive number or NaN"),
        ({"width_px": [9.0, np.inf]}, "width_px of target far is inf"),
        ({"sigma_width_px": 0.0}, "sigma_width_px of target near is 0"),
        ({"spacing_px": 9.0, "sigma_spacing_px": np.nan}, "sigma_spacing_px of target near is nan"),
        ({"spacing_mm": np.inf}, "spacing_mm of target near is inf"),
        ({"labels": ("one",)}, "labels holds 1 entries; give 2 texts"),
    ],
)
def test_faults_name_the_target_and_the_remedy(change, message):
    good = {"row": [1.0, 2.0], "range_mm": [800.0, 900.0], "labels": ("near", "far")}
    with pytest.raises(ArgumentError, match=message) as refused:
        Targets(**(good | change))
    assert "\n" not in str(refused.value)


def test_no_parts_are_refused():
    with pytest.raises(ArgumentError, match="parts is empty"):
        Targets.concatenate([])
