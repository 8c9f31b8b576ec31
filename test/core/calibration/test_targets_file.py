"""Targets and distances from CSV files."""

import math

import numpy as np
import pytest

from eschorty_ros.core.base.errors import FormatError
from eschorty_ros.core.calibration import Targets, read_distances, read_targets, write_targets


def written(tmp_path, text, name="targets.csv"):
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_a_bare_list_is_enough(tmp_path):
    targets = read_targets(written(tmp_path, "row,range_mm\n49.5,820\n702.1,2050.0\n"))
    assert targets.row.tolist() == [49.5, 702.1]
    assert targets.range_mm.tolist() == [820.0, 2050.0]
    assert (targets.sigma_row_px[0], targets.sigma_range_mm[0]) == (0.3, 1.0)
    assert targets.labels == ("line 2", "line 3")
    assert targets.lateral == 0


def test_every_column_in_any_order_with_gaps_and_comments(tmp_path):
    text = (
        "\ufeff# posts of Monday\r\nlabel, range_mm,row,size_mm,width_px,row_sigma,column\r\n\r\n"
        "near,820,49.5,25.4,154.0,0.2,100\r\n#left out,1,1,1,1,1,1\r\nfar , 2050,702.1,,,,\r\n"
    )
    targets = read_targets(written(tmp_path, text), sigma_row_px=0.5, sigma_range_mm=2.0)
    assert targets.labels == ("near", "far")
    assert targets.sigma_row_px.tolist() == [0.2, 0.5]
    assert targets.sigma_range_mm.tolist() == [2.0, 2.0]
    assert targets.has_width.tolist() == [True, False]
    assert targets.column[0] == 100.0
    assert math.isnan(targets.column[1])


def test_written_targets_come_back_to_the_last_bit(tmp_path):
    nan = math.nan
    targets = Targets(
        [53.1, 1.0 / 3.0], [820.0, 2050.0000000000002], [0.1, 0.3], [0.0, 1e-9],
        column=[nan, 639.5], width_px=[nan, 154.2], sigma_width_px=[nan, 0.4],
        size_mm=[nan, 25.4], sigma_shared_mm=[0.0, 1.0 / 7.0],
        labels=["near, left", "posts \u201cA\u201d"],
    )  # fmt: skip
    write_targets(tmp_path / "targets.csv", targets)
    back = read_targets(tmp_path / "targets.csv")
    assert back.labels == targets.labels
    for name in ("row", "range_mm", "sigma_row_px", "sigma_range_mm", "column", "width_px",
                 "size_mm", "spacing_px", "sigma_shared_mm"):  # fmt: skip
        np.testing.assert_array_equal(getattr(back, name), getattr(targets, name), err_msg=name)
    assert back.has_width.tolist() == [False, True]


def test_distances_with_sizes_and_hints(tmp_path):
    text = "range_mm,size_mm,column,label\n820,12.7,100,near\n2050,,,\n"
    near, far = read_distances(written(tmp_path, text))
    assert (near.range_mm, near.size_mm, near.column, near.label) == (820.0, 12.7, 100.0, "near")
    assert (near.sigma_range_mm, far.label, far.hinted) == (1.0, "2050 mm", False)
    assert np.isnan(far.size_mm)
    with pytest.raises(FormatError, match=r"line 2: range_mm is -5.0; choose a positive"):
        read_distances(written(tmp_path, "range_mm\n-5\n"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "it has no lines; begin with the header row,range_mm"),
        ("row,range_mm\n", "a header and no targets"),
        ("row\n1\n", "column 'range_mm' is missing; add it"),
        ("row,range\n1,2\n", "column 'range' is not known; did you mean range_mm?"),
        ("row,range_mm,row\n1,2,3\n", "column 'row' appears twice"),
        ("row,range_mm\n1,2\n1\n", "line 3: it has 1 cells and the header 2"),
        ("row,range_mm\n1,\n", "line 2: range_mm is empty; write a number"),
        ("row,range_mm\n1,abc\n", "line 2: range_mm is 'abc'; write a number"),
        ("row,range_mm\n1,nan\n", "line 2: range_mm is 'nan'; write a number"),
        ("row,range_mm\n1,1e999\n", "line 2: range_mm is '1e999'"),
        ("row,range_mm\n1,-5\n", "range_mm of target line 2 is -5; choose a positive range"),
        ('row,range_mm,label\n1,2,"left\n3,4,\n', "line 3: unexpected end of data"),
        ("row;range_mm\n1;2\n", "its header is 'row;range_mm'; separate columns by commas"),
        (b"\xff\xfe\x00", "save it as CSV in UTF-8"),
    ],
)
def test_faults_name_file_line_and_column(tmp_path, text, message):
    path = written(tmp_path, text)
    with pytest.raises(FormatError) as refused:
        read_targets(path)
    assert message in str(refused.value)
    assert "targets.csv" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_path_that_cannot_be_read_is_named(tmp_path):
    for path in (tmp_path, tmp_path / "absent.csv"):
        with pytest.raises(FormatError, match="cannot read"):
            read_targets(path)
