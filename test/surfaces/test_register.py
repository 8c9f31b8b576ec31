"""Clouds in one frame: known poses within the reported covariance."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from grid_clouds import PITCH_Y, cloud, moved
from scipy.spatial.transform import Rotation

from eschorty_ros.cli import main
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.storage import POINT_DTYPE, read_cloud, write_cloud
from eschorty_ros.report.surface_figures import joined_figure
from eschorty_ros.surfaces.grid import organise
from eschorty_ros.surfaces.register import join, pose_matrix, register

pytestmark = pytest.mark.usefixtures("open3d")


def relief(y, z):
    waves = 6.0 * np.sin(y / 5.0 + 0.3 * np.sin(z / 9.0)) * np.cos(z / 7.0)
    return 1300.0 + waves + 3.0 * np.sin(z / 3.1)


def ball(y, z):
    """A ball of 15 mm up to near its rim, where surfaces are steep and normals one-sided."""
    aside = (y - 20.0) ** 2 + (z + 25.0) ** 2
    return np.where(aside < 14.0**2, 1290.0 - np.sqrt(np.maximum(225.0 - aside, 0.0)), np.nan)


def cone(y, z):
    aside = np.hypot(y - 20.0, z + 25.0)
    return np.where(aside < 18.0, 1290.0 + aside, np.nan)


def known_pose(seed):
    """Some 0.4 degrees about the middle of the cloud, and 1 mm."""
    rng = np.random.default_rng(seed)
    pose = pose_matrix([0.0, 0.0, 0.0, *rng.normal(0.0, 0.4, 3)])
    middle = np.array([1.3, 0.02, 0.0])
    pose[:3, 3] = middle - pose[:3, :3] @ middle + rng.normal(0.0, 1e-3, 3)
    return pose


def test_known_poses_are_within_the_reported_covariance():
    ratios = []
    for seed in range(4):
        true = known_pose(seed)
        first, other = cloud(relief, seed=2 * seed), cloud(relief, seed=2 * seed + 1)
        pose = register(first, moved(other, true))
        off = pose.transform @ np.linalg.inv(true)
        turn = Rotation.from_matrix(off[:3, :3]).as_rotvec()
        centre = pose.centre_mm * 1e-3
        shift_mm = (off[:3, :3] @ centre + off[:3, 3] - centre) * 1e3
        error = np.concatenate([turn, shift_mm])
        ratios.append(error / np.sqrt(np.diag(pose.covariance)))
        assert np.linalg.eigvalsh(pose.covariance)[0] > 0.0
        assert np.all(pose.sigmas < [0.1, 0.1, 0.1, 0.05, 0.05, 0.05])
        assert pose.overlap > 0.9
    assert np.mean(np.abs(ratios) < 2.0) > 0.93
    assert 0.3 < np.sqrt(np.mean(np.square(ratios))) < 1.4


def test_a_shift_by_half_a_pitch_is_not_drawn_to_the_grid():
    """Of two partners equally far the one with a similar error of the range must not count more."""
    first = cloud(relief, smooth=1, seed=20)
    half_mm = PITCH_Y / 2.0
    other = cloud(lambda y, z: relief(y + half_mm, z), smooth=1, seed=21)
    pose = register(first, other, reach_mm=5.0)
    error = pose.shift_mm - [0.0, half_mm, 0.0]
    print(f"seeds 20, 21: {error} mm, {error / pose.sigmas[3:]} sigma")
    assert np.abs(error / pose.sigmas[3:]).max() < 2.0
    assert np.abs(error).max() < 0.02


def test_a_wall_at_the_rim_of_a_steep_surface_does_not_hold_the_cloud():
    """Its normals there are of the wall alone."""

    def side(y, z):
        waves = 3.0 * np.sin(z / 9.0) * np.cos(y / 11.0) + z**2 / 120.0
        wall = 10.0 / (1.0 + np.exp((y - 2.0) / 0.3))
        return 1300.0 - 2.5 * y - y**2 / 60.0 + waves - wall

    start_mm = 3.4 * PITCH_Y
    first, other = (
        cloud(lambda y, z, low=low: side(y + low, z), sigma_mm=0.1, seed=seed)
        for seed, low in enumerate((0.0, start_mm))
    )
    pose = register(first, other)
    error = np.concatenate([pose.rotation_deg, pose.shift_mm - [0.0, start_mm, 0.0]])
    assert np.abs(error / pose.sigmas).max() < 3.0, "seeds 0 and 1"


@pytest.mark.parametrize(
    ("surface", "words"),
    [
        (lambda y, z: 1300.0 + 0.1 * y + 0.0 * z, "slides along"),
        (lambda y, z: 1300.0 + 4.0 * np.sin(y / 5.0) + 0.0 * z, "slides along z"),
        (ball, "turns about|slides along"),
        (cone, "turns about x"),
    ],
)
@pytest.mark.parametrize("sigma_mm", [0.08, 0.6])
def test_surfaces_that_slide_are_refused_whatever_the_noise(surface, words, sigma_mm):
    first, other = (cloud(surface, sigma_mm, seed=seed) for seed in (1, 2))
    with pytest.raises(ArgumentError, match=words):
        register(*(points[points["column"] < 200] for points in (first, other)))


@pytest.mark.parametrize(
    "surface",
    [
        lambda y, z: 1300.0 + 0.6 * np.maximum(0.0, 12.0 - np.abs(z + 25.0)) + 0.0 * y,
        lambda y, z: 1300.0 + ((y - 20.0) ** 2 + (z + 25.0) ** 2) / 100.0,
    ],
    ids=["groove", "bowl"],
)
def test_one_sided_normals_at_a_rim_are_no_relief(surface):
    """Nearly without noise they are most of what a cloud shows that slides or turns."""
    first, other = (cloud(surface, sigma_mm=0.02, smooth=1, seed=seed) for seed in (2, 3))
    with pytest.raises(ArgumentError, match=r"slides along y|turns about x"):
        register(first, moved(other, known_pose(4)))


def test_clouds_apart_are_refused_and_a_start_brings_them_together():
    first, other = cloud(relief), cloud(relief, seed=2)
    away = known_pose(1) @ pose_matrix([200.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    with pytest.raises(ArgumentError, match="give clouds that overlap"):
        register(first, moved(other, away))
    pose = register(first, moved(other, away), pose_matrix([200.0, 0, 0, 0, 0, 0]))
    assert np.abs(pose.transform - away).max() < 2e-3
    joined = join(first, moved(other, away), pose)
    # One long sweep: 60 periods of each.
    lines = np.flatnonzero(organise(joined).known.any(axis=1))
    assert len(lines) == 120


def test_a_start_too_far_away_is_told_from_a_surface_without_relief():
    """14 mm along z the waves meet others, 4 sigma from them at best."""
    first, other = cloud(relief), cloud(relief, seed=2)
    away = pose_matrix([0.0, 0.0, 14.0, 0.0, 0.0, 0.0])
    with pytest.raises(
        ArgumentError, match=r"do not fit: .* sigma from the first cloud; give a st"
    ):
        register(first, moved(other, away))


def test_a_cloud_of_a_stage_at_rest_has_no_pose():
    first, line = cloud(relief), cloud(lambda y, z: relief(20.0, z) + 0.0 * y, seed=2)
    line["y"] = 20e-3
    with pytest.raises(ArgumentError, match="turns about z on the first one"):
        register(first, line)
    with pytest.raises(ArgumentError, match="the first cloud is a line; give a cloud of a sweep"):
        register(line, first)


def test_the_command_joins_clouds(tmp_path):
    true = known_pose(3)
    write_cloud(tmp_path / "a.pcd", cloud(relief, seed=7))
    write_cloud(tmp_path / "b.ply", moved(cloud(relief, seed=8), true))
    arguments = ["register", *(str(tmp_path / name) for name in ("a.pcd", "b.ply"))]
    out = tmp_path / "both.ply"
    done = CliRunner().invoke(main, [*arguments, "--out", str(out), "--json"])
    assert done.exit_code == 0, done.output
    facts = json.loads(done.stdout)
    assert np.abs(np.array(facts["poses"][0]["transform_m"]) - true).max() < 2e-3
    assert len(read_cloud(out)) == facts["points"] == 48_000
    assert out.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    assert CliRunner().invoke(main, arguments[:2]).exit_code == 2
    write_cloud(tmp_path / "few.pcd", cloud(relief)[::900])
    few = CliRunner().invoke(main, [*arguments[:2], str(tmp_path / "few.pcd"), "--out", str(out)])
    assert (few.exit_code, few.stdout) == (1, "")
    assert "few.pcd onto" in few.stderr.splitlines()[-1]
    replaced = CliRunner().invoke(main, [*arguments, "--out", arguments[2]])
    assert "b.ply is the cloud to read" in replaced.stderr
    assert len(read_cloud(arguments[2])) == 24_000
    printed = CliRunner().invoke(main, [*arguments, "--out", str(out)]).stdout
    assert "shift mm" in printed
    assert "rms/sigma" in printed
    assert f"{out},{out.with_suffix('.png')}:" in "".join(printed.split())


def test_the_same_scan_twice_has_a_warning(tmp_path):
    file = str(tmp_path / "a.ply")
    write_cloud(file, cloud(relief))
    done = CliRunner().invoke(main, ["register", file, file, "--out", str(tmp_path / "b.ply")])
    assert done.exit_code == 0, done.output
    assert "check that it is another scan" in done.stderr


def test_the_legend_of_a_flat_cloud_is_beside_its_picture():
    points = np.zeros(20, POINT_DTYPE)
    points["y"], points["z"] = np.linspace(0.0, 0.01, 20), np.linspace(-0.2, 0.2, 20)
    figure = joined_figure(points, (10, 10), "flat")
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["cloud 1", "cloud 2"]
    figure.draw_without_rendering()
    below = legend.get_window_extent().y1
    assert all(axes.get_tightbbox().y0 >= below for axes in figure.axes)
