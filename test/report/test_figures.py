"""The pictures are written and show what they should."""

from itertools import combinations

import numpy as np
import pytest

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.storage import POINT_DTYPE
from eschorty_ros.report import figures


def step_cloud(lines=24, columns=320):
    """A step of 40 mm in stage and column, with 1 mm noise."""
    rng = np.random.default_rng(2)
    line, column = (a.ravel() for a in np.mgrid[0:lines, 0:columns])
    true = 1300.0 + 40.0 * ((line > lines // 2) ^ (column > columns // 2))
    points = np.zeros(line.size, POINT_DTYPE)
    error = rng.normal(0.0, 1.0, line.size)
    points["x"], points["y"] = (true + error) * 1e-3, line * 0.7e-3
    points["z"] = (column - columns / 2) * 0.26e-3
    points["t"] = line / 70.0 + rng.normal(0, 1e-4, line.size)
    points["column"], points["sigma"] = column, 1e-3
    return points, error


def png_size(path):
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")


def labels_of(figure):
    return {label for axes in figure.axes for label in (axes.get_xlabel(), axes.get_ylabel())}


def test_scan_figure_has_every_part_with_units(tmp_path):
    points, error = step_cloud()
    figure = figures.scan_figure(points, error, "a step")
    labels = labels_of(figure)
    assert {"stage position (mm)", "range (mm)", "range error (mm)", "density"} <= labels
    figures.save(figure, tmp_path / "scan.png")
    width, height = png_size(tmp_path / "scan.png")
    assert width > 1000
    assert height > 700
    assert (tmp_path / "scan.png").stat().st_size < 500_000


def test_a_map_of_a_resting_stage_has_no_scale_of_positions():
    points, error = step_cloud()
    points["y"] = 0.012
    labels = labels_of(figures.scan_figure(points, error))
    assert "profiles, stage at 12 mm" in labels
    assert "stage position (mm)" not in labels


def thin_sheet(points):
    """The same cloud 3 mm deep: a short side beside two long ones."""
    flat = points.copy()
    flat["x"] = 1.3 + (points["x"] - 1.3) * 0.03
    return flat


@pytest.mark.parametrize("change", [lambda points: points, thin_sheet])
def test_labels_of_the_3d_view_are_inside_and_apart(change):
    figure = figures.scan_figure(change(step_cloud(lines=200)[0]))
    figure.canvas.draw()
    view = next(axes for axes in figure.axes if hasattr(axes, "zaxis"))
    boxes, names = [], []
    for axis in (view.xaxis, view.yaxis, view.zaxis):
        for text in (axis.label, *(tick.label1 for tick in axis.get_major_ticks())):
            if text.get_visible() and text.get_text():
                boxes.append(text.get_window_extent())
                names.append(text.get_text())
    assert len(names) >= 8
    edge = figure.bbox
    for box, name in zip(boxes, names, strict=True):
        assert edge.x0 <= box.x0 <= box.x1 <= edge.x1, name
        assert edge.y0 <= box.y0 <= box.y1 <= edge.y1, name
    # Tick labels are upright; the names' boxes are those of slanted text and reach further.
    ticks = [k for k, name in enumerate(names) if "mm" not in name]
    for one, other in combinations(ticks, 2):
        assert not boxes[one].overlaps(boxes[other]), (names[one], names[other])


def test_without_truth_there_is_no_error_map():
    figure = figures.scan_figure(step_cloud()[0])
    assert "range error (mm)" not in labels_of(figure)


def test_the_depth_map_holds_each_point_once():
    points, _ = step_cloud()
    axes = figures.scan_figure(points).axes[0]
    (image,) = axes.images
    assert (axes.get_xlabel(), axes.get_aspect()) == ("along the line (mm)", 1.0)
    assert image.get_array().shape == (24, 320)
    np.testing.assert_allclose(image.get_array().ravel(), points["x"] * 1e3, rtol=1e-6)
    np.testing.assert_allclose(
        image.get_extent(), (-160.5 * 0.26, 159.5 * 0.26, -0.35, 23.5 * 0.7), atol=1e-3
    )


def test_a_pass_back_is_drawn_where_it_was():
    forth, _ = step_cloud()
    back = forth.copy()
    back["t"] = 2.0 - back["t"]
    back["y"] += 0.2e-3
    figure = figures.scan_figure(np.concatenate([forth, back]))
    depth = next(axes for axes in figure.axes if axes.get_title() == "Depth map")
    image = depth.images[0].get_array()
    nearer = (image[:, 0] < 1320.0)[~np.isnan(np.asarray(image)[:, 0])]
    assert len(nearer) == 48
    assert np.count_nonzero(np.diff(nearer)) == 1


@pytest.mark.parametrize(("lines", "known"), [(1, True), (3, False)])
def test_one_profile_and_an_error_that_is_nowhere_known_are_drawn(tmp_path, lines, known):
    points, error = step_cloud(lines)
    error = error if known else np.full_like(error, np.nan)
    figures.save(figures.scan_figure(points, error), tmp_path / "scan.png")
    png_size(tmp_path / "scan.png")


def test_an_empty_cloud_is_refused():
    with pytest.raises(ArgumentError, match="0 points"):
        figures.scan_figure(np.empty(0, POINT_DTYPE))


def test_a_path_that_cannot_be_written_is_one_line(tmp_path):
    figure = figures.scan_figure(step_cloud(lines=2)[0])
    with pytest.raises(ArgumentError, match="cannot write the picture") as failure:
        figures.save(figure, tmp_path / "scan.nonsense")
    assert "\n" not in str(failure.value)
