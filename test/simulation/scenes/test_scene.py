"""Scenes: where the rays of the laser sheet hit."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from eschorty_ros.core.base.errors import ArgumentError, EschortyError, FormatError
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.simulation.scenes import NAMES, Plane, Sphere, Steps, load_open3d, named

MODEL = replace(load_calibration("config_3"), b_mm=7.0).model()
STAGE = np.linspace(0.0, 100.0, 41)
COLUMNS = np.arange(0, 1280, 13)


def hit_points(scene) -> np.ndarray:
    """Hits as (stage, column, xyz) in eschorty_base, mm."""
    x = scene.range_mm(STAGE, COLUMNS, MODEL)
    assert x.shape == (STAGE.size, COLUMNS.size)
    assert scene.reflectance(STAGE, COLUMNS, MODEL).shape == x.shape
    y = np.broadcast_to(STAGE[:, None], x.shape)
    z = MODEL.column_slope(COLUMNS)[None, :] * (x + MODEL.b_mm)
    return np.stack((x, y, z), axis=-1)


def test_hits_lie_on_the_plane() -> None:
    plane = Plane(1320.0, slope_stage=-0.7, slope_column=1.3, pivot_mm=40.0)
    x, y, z = np.moveaxis(hit_points(plane), -1, 0)
    assert np.max(np.abs(x - (1320.0 - 0.7 * (y - 40.0) + 1.3 * z))) < 1e-9


def test_rays_that_run_away_from_a_steep_plane_miss() -> None:
    # Ray and plane are parallel at slope 1 / 20.
    x = Plane(1320.0, slope_column=20.0).range_mm([0.0], COLUMNS, MODEL)[0]
    away = MODEL.column_slope(COLUMNS) >= 0.05
    assert np.isnan(x[away]).all()
    assert np.isfinite(x[~away]).all()


def test_hits_lie_on_the_near_side_of_the_sphere_or_miss() -> None:
    ball = Sphere(1320.0, 50.0, -20.0, 45.0, backdrop_mm=None)
    points = hit_points(ball)
    centre = np.array((1320.0, 50.0, -20.0))
    hit = np.isfinite(points[..., 0])
    assert 0.05 < hit.mean() < 0.5
    distance = np.linalg.norm(points[hit] - centre, axis=-1)
    assert np.max(np.abs(distance - 45.0)) < 1e-9
    # Outward normal against the ray: the first of the two crossings.
    origin = np.stack(np.broadcast_arrays(-MODEL.b_mm, points[..., 1], 0.0), axis=-1)
    facing = np.sum((points - centre) * (points - origin), axis=-1)[hit]
    assert facing.max() <= 1e-6
    # A miss means that the ray passes the centre at more than the radius.
    slope = MODEL.column_slope(COLUMNS)[None, :]
    direction = np.stack((np.ones_like(slope), np.zeros_like(slope), slope), axis=-1)
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    start = np.stack((np.full(STAGE.size, -MODEL.b_mm), STAGE, np.zeros(STAGE.size)), axis=-1)
    off = (centre - start)[:, None, :]
    apart = np.linalg.norm(np.cross(off, direction), axis=-1)
    assert np.array_equal(apart < 45.0, hit)


def test_backdrop_fills_what_the_sphere_leaves() -> None:
    bare = Sphere(backdrop_mm=None).range_mm(STAGE, COLUMNS, MODEL)
    backed = Sphere(backdrop_mm=1400.0).range_mm(STAGE, COLUMNS, MODEL)
    assert np.isfinite(backed).all()
    assert np.array_equal(backed, np.where(np.isnan(bare), 1400.0, bare))


def test_default_steps_have_the_promised_depths() -> None:
    scene = Steps()
    x = scene.range_mm(np.arange(0.5, 220.0, 1.0), np.arange(1280), MODEL)
    assert np.ptp(x) == pytest.approx(207.0)
    assert 1200.0 < x.min() < x.max() < 1450.0
    steps = np.unique(np.abs(np.diff(x[10])))
    assert {2.0, 3.0, 5.0} <= set(np.round(steps, 9))
    assert len(np.unique(x)) > 20
    row = load_calibration("config_3").model().row(x)
    assert 20 < row.min() < row.max() < 700


def test_steps_change_exactly_at_the_bands() -> None:
    scene = Steps(1000.0, (0.0, 10.0), (0.0, 1.0, 2.0), 10.0)
    x = scene.range_mm([-5.0, 9.999, 10.0, 25.0, 99.0], [0, 639, 640, 1279], MODEL)
    assert x[:, 0].tolist() == [1000.0, 1000.0, 1001.0, 1002.0, 1002.0]
    assert x[0].tolist() == [1000.0, 1000.0, 1010.0, 1010.0]


def test_names_build_scenes_and_others_are_refused(tmp_path) -> None:
    for name in NAMES:
        x = named(name).range_mm(STAGE, COLUMNS, MODEL)
        assert x.shape == (STAGE.size, COLUMNS.size), name
        assert np.isfinite(x).all() or name in ("leaves", "face", "posts"), name
    with pytest.raises(ArgumentError, match="steps, plane"):
        named("stepps")
    with pytest.raises(ArgumentError, match="neither a name nor a file"):
        named(tmp_path / "missing.ply")


def test_impossible_shapes_are_refused() -> None:
    with pytest.raises(ArgumentError, match="radius_mm"):
        Sphere(radius_mm=0.0)
    with pytest.raises(ArgumentError, match="stage_band_mm"):
        Steps(stage_band_mm=-1.0)
    with pytest.raises(ArgumentError, match="levels"):
        Steps(column_levels_mm=())


def test_a_mesh_without_open3d_names_the_package(tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    path = tmp_path / "mesh.ply"
    path.write_bytes(b"ply\n")
    with pytest.raises(EschortyError, match="pip install open3d"):
        named(path)


def test_a_mesh_without_a_library_that_open3d_links_names_its_package(tmp_path, monkeypatch):
    (tmp_path / "open3d.py").write_text("raise ImportError('libEGL.so.1: cannot open')")
    monkeypatch.delitem(sys.modules, "open3d", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(EschortyError, match=r"libEGL.so.1: .*; run: apt install libegl1 "):
        load_open3d("a mesh")


@pytest.mark.parametrize("ending", [KeyboardInterrupt, SystemExit])
def test_a_signal_while_open3d_is_imported_ends_the_process(tmp_path, monkeypatch, ending):
    text = f"raise ImportError('initialization failed') from {ending.__name__}(143)"
    (tmp_path / "open3d.py").write_text(text)
    monkeypatch.delitem(sys.modules, "open3d", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ending, match="143"):
        load_open3d("a mesh")


@pytest.mark.usefixtures("open3d")
def test_mesh_agrees_with_the_analytic_plane() -> None:
    from eschorty_ros.simulation.scenes import Mesh

    plane = Plane(1320.0, slope_stage=0.5, slope_column=-0.4, pivot_mm=50.0)
    y, z = np.array([-500.0, 500.0, 500.0, -500.0]), np.array([-900.0, -900.0, 900.0, 900.0])
    x = 1320.0 + 0.5 * (y - 50.0) - 0.4 * z
    mesh = Mesh(np.stack((x, y, z), axis=-1) * 1e-3, [[0, 1, 2], [0, 2, 3]])
    got = mesh.range_mm(STAGE, COLUMNS, MODEL)
    assert np.max(np.abs(got - plane.range_mm(STAGE, COLUMNS, MODEL))) < 2e-3


def test_mesh_file_agrees_with_the_analytic_sphere(tmp_path, open3d) -> None:
    ball = open3d.geometry.TriangleMesh.create_sphere(0.040, 300)
    ball.translate((1.320, 0.050, 0.0))
    path = tmp_path / "ball.ply"
    assert open3d.io.write_triangle_mesh(str(path), ball)
    got = named(path).range_mm(STAGE, COLUMNS, MODEL)
    truth = Sphere(backdrop_mm=None).range_mm(STAGE, COLUMNS, MODEL)
    both = np.isfinite(got) & np.isfinite(truth)
    assert both.sum() > 0.98 * np.isfinite(truth).sum()
    assert np.isnan(got).sum() > 0
    error = np.abs(got - truth)[both]
    assert np.median(error) < 5e-3
    # The polyhedron's rim recedes: only grazing rays differ by more.
    assert np.percentile(error, 98) < 0.1


@pytest.mark.usefixtures("open3d")
def test_an_empty_mesh_is_refused(tmp_path) -> None:
    path = tmp_path / "empty.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
        "property float z\nend_header\n0 0 0\n"
    )
    with pytest.raises(FormatError, match="no triangles"):
        named(path)
