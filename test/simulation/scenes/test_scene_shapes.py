"""The leaf collage and the face: depths, separations, and that every hit lies on its surface."""

from dataclasses import replace

import numpy as np
import pytest

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.simulation.scenes import EAR_OFF_MM, LEVELS, SEPARATION_MM, Face, Leaves

STAGE = np.arange(0.0, 200.0, 0.5)
COLUMNS = np.arange(0, 1280, 2)
CONFIG_3 = load_calibration("config_3").model()
CONFIG_2 = load_calibration("config_2").model()


def curved_away(leaves: Leaves, x: np.ndarray, model) -> np.ndarray:
    """Range without the layers' curvature."""
    return x - leaves.curvature_mm(STAGE[:, None], model.column_slope(COLUMNS) * (x + model.b_mm))


@pytest.mark.parametrize("model", [CONFIG_3, CONFIG_2], ids=["config_3", "config_2"])
@pytest.mark.parametrize("scene", [Leaves(), Face()], ids=["leaves", "face"])
def test_all_of_the_scene_is_in_view(scene, model) -> None:
    x = scene.range_mm(STAGE, COLUMNS, model)
    albedo = scene.reflectance(STAGE, COLUMNS, model)
    row = model.row(x[np.isfinite(x)])
    assert 20.0 < row.min() < row.max() < model.rows - 20.0
    assert 0.35 < np.isfinite(x).mean() < 0.65
    assert np.array_equal(albedo > 0.0, np.isfinite(x))
    assert np.isfinite(albedo).all()
    assert 0.4 < albedo[albedo > 0.0].min() < albedo.max() <= 1.0


def test_the_face_of_the_paper_is_in_view_of_the_second_build_alone() -> None:
    x = Face(2430.0).range_mm(STAGE, COLUMNS, CONFIG_2)
    row = CONFIG_2.row(x[np.isfinite(x)])
    assert 650.0 < row.min() < row.max() < 719.0
    assert np.nanmin(Face(2430.0).range_mm(STAGE, COLUMNS, CONFIG_3)) > CONFIG_3.range_limits_mm[1]


def test_leaves_span_three_layers_over_210_mm() -> None:
    leaves = Leaves()
    levels = np.unique([leaf.depth_mm for leaf in leaves.leaves])
    assert levels.size == 3 * LEVELS
    assert np.ptp(levels) == pytest.approx(210.0)
    assert leaves.centre_mm in levels
    np.testing.assert_allclose(np.diff(levels.reshape(3, LEVELS)), SEPARATION_MM)
    x = leaves.range_mm(STAGE, COLUMNS, CONFIG_3)
    assert np.nanmax(x) - np.nanmin(x) == pytest.approx(210.0, abs=3.0)


def test_overlapping_leaves_are_2_mm_apart_at_1320_mm() -> None:
    leaves = Leaves()
    x = leaves.range_mm(STAGE, COLUMNS, CONFIG_3)
    index = leaves.leaf_index(STAGE, COLUMNS, CONFIG_3)
    depth = np.array([leaf.depth_mm for leaf in leaves.leaves])
    # Blades and veins: nothing but up to 0.6 mm of veins stands out of a leaf's own level.
    height = (depth[index] - curved_away(leaves, x, CONFIG_3))[index >= 0]
    assert -1e-9 < height.min() < height.max() <= 0.6 + 1e-9
    assert np.median(height) < 0.05
    # Neighbouring columns on two leaves of the middle layer: their levels' distance.
    middle = np.abs(depth[index] - 1320.0) < 10.0
    pair = middle[:, :-1] & middle[:, 1:] & (index[:, :-1] >= 0) & (index[:, 1:] >= 0)
    step = np.abs(np.diff(x, axis=1))[pair & (index[:, :-1] != index[:, 1:])]
    assert step.size > 200
    # Up to three veins of one leaf or the other, and the curvature between two columns.
    assert np.mean(np.abs(step - SEPARATION_MM) < 0.7) > 0.5
    assert step.max() < 2.0 * SEPARATION_MM + 0.8


def test_leaf_hits_lie_on_the_leaf_they_name() -> None:
    leaves = Leaves()
    x = leaves.range_mm(STAGE, COLUMNS, CONFIG_3)
    index = leaves.leaf_index(STAGE, COLUMNS, CONFIG_3)
    assert np.array_equal(index >= 0, np.isfinite(x))
    assert len(np.unique(index)) > 18
    z = CONFIG_3.column_slope(COLUMNS) * (x + CONFIG_3.b_mm)
    for k, leaf in enumerate(leaves.leaves):
        at = index == k
        y = np.broadcast_to(STAGE[:, None], x.shape)[at]
        along, across = leaf.place(y, z[at])
        surface = leaf.depth_mm + leaves.curvature_mm(y, z[at]) - leaf.vein_mm(along, across)
        assert np.max(np.abs(surface - x[at]), initial=0.0) < 2e-3
        # The first leaf a ray meets: no nearer one covers the same place.
        for other in leaves.leaves:
            if other.depth_mm < leaf.depth_mm - 100.0:
                depth = other.depth_mm + CONFIG_3.b_mm
                z_there = CONFIG_3.column_slope(COLUMNS) * depth
                covered = other.covers(*other.place(STAGE[:, None], z_there[None, :]))
                # A ray meets the two layers' curved surfaces within 0.5 mm of the flat ones.
                assert np.count_nonzero(covered & at) <= 0.05 * np.count_nonzero(at) + 60


def test_a_seed_fixes_the_collage() -> None:
    first = Leaves(seed=3).range_mm(STAGE, COLUMNS, CONFIG_3)
    assert np.array_equal(first, Leaves(seed=3).range_mm(STAGE, COLUMNS, CONFIG_3), equal_nan=True)
    other = Leaves(seed=4).range_mm(STAGE, COLUMNS, CONFIG_3)
    assert np.mean(np.isfinite(first) != np.isfinite(other)) > 0.1


def test_rays_may_come_one_by_one_and_in_any_order() -> None:
    for scene in (Leaves(), Face()):
        complete = scene.range_mm(STAGE, COLUMNS, CONFIG_3)
        columns = COLUMNS[::-7]
        single = np.array([scene.range_mm(s, columns, CONFIG_3)[0] for s in STAGE[::40]])
        assert np.array_equal(single, complete[::40, ::-7], equal_nan=True)


def test_the_face_has_nose_eyes_mouth_and_ears() -> None:
    face = Face()
    x = face.range_mm(STAGE, COLUMNS, CONFIG_3)
    z = CONFIG_3.column_slope(COLUMNS) * (x + CONFIG_3.b_mm)

    def depth(across: float, up: float) -> float:
        line = np.argmin(np.abs(STAGE - 100.0 - across))
        return float(x[line, np.nanargmin(np.abs(z[line] - up))])

    assert np.nanmin(x) == pytest.approx(depth(0.0, -11.0), abs=0.5)
    assert depth(0.0, 15.0) < depth(18.0, 22.0) - 8.0, "the bridge stands between the eyes"
    assert depth(29.0, 28.0) > depth(29.0, 40.0) + 3.0, "brows above the sockets"
    assert depth(0.0, -48.0) > max(depth(0.0, -43.0), depth(0.0, -54.0)) + 1.0, "mouth"
    ear = depth(EAR_OFF_MM + 6.0, 2.0)
    assert ear > depth(60.0, 2.0) + 30.0, "ears lie behind the cheeks"
    assert np.nanmax(x) - np.nanmin(x) == pytest.approx(114.0, abs=3.0)
    # Mirrored about the nose, stage 100 mm being sample 200.
    assert np.allclose(x[1:200], x[399:200:-1], atol=1e-9, equal_nan=True)


def test_the_face_is_the_same_object_from_another_place() -> None:
    every = np.arange(1280)
    moved = replace(load_calibration("config_3"), b_mm=5.0).model()
    lines = []
    for model in (CONFIG_3, moved):
        x = Face().range_mm([100.0], every, model)[0]
        known = np.isfinite(x)
        lines.append((model.lateral_mm(every, x)[known], x[known]))
    (z, x), (z_moved, x_moved) = lines
    inner = np.abs(z) < 95.0
    # Linear interpolation over 0.2 mm where the lips bend by 1 mm in 4 mm.
    assert np.max(np.abs(np.interp(z, z_moved, x_moved) - x)[inner]) < 0.03


def test_impossible_shapes_are_refused() -> None:
    with pytest.raises(ArgumentError, match="leaves_per_layer is 0"):
        Leaves(leaves_per_layer=0)
    with pytest.raises(ArgumentError, match="centre_mm is -1"):
        Face(centre_mm=-1.0)
