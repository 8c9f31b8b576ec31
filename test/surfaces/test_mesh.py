"""Meshes of clouds: within the points' errors, no bridge over a step, written in three forms."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from grid_clouds import PITCH_Y, PITCH_Z, cloud

from eschorty_ros.cli import main
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.storage import write_cloud
from eschorty_ros.surfaces.mesh import mesh
from eschorty_ros.surfaces.plane import POINTS_MIN

pytestmark = pytest.mark.usefixtures("open3d")


def ball(y, z):
    """A ball of 15 mm before a wall, with a slot where nothing is."""
    deep = 225.0 - (y - 20.0) ** 2 - z**2
    x = np.where(deep > 0.0, 1290.0 - np.sqrt(np.maximum(deep, 0.0)), 1300.0)
    return np.where(np.abs(z - 35.0) < 2.0, np.nan, x)


def test_a_mesh_keeps_few_points_within_their_errors():
    made = mesh(cloud(ball, smooth=1))
    errors = [level.error_sigmas for level in made.levels]
    chosen = made.levels[made.chosen]
    assert chosen.error_sigmas <= 2.0
    assert made.chosen == len(errors) - 1 or errors[made.chosen + 1] > 2.0
    assert len(made.vertices) == chosen.vertices < 0.1 * made.points
    x, y, z = made.vertices.T
    inside = (y - 20.0) ** 2 + z**2 < 12.0**2
    off = np.sqrt((x - 1290.0) ** 2 + (y - 20.0) ** 2 + z**2)[inside] - 15.0
    assert np.abs(off).max() < 2.0 * 0.3
    # Nothing joins ball and wall, nor the two sides of the slot.
    corners = made.vertices[made.triangles]
    spans = corners.max(axis=1) - corners.min(axis=1)
    on_wall = (corners[:, :, 0] > 1295.0).sum(axis=1)
    assert set(on_wall) <= {0, 3}
    assert not np.any((corners[:, :, 2].min(axis=1) < 33.5) & (corners[:, :, 2].max(axis=1) > 36.5))
    assert spans[:, 1].max() < 60 * PITCH_Y
    # Fronts face the sensor, which is at small x.
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.mean(normal[:, 0] < 0.0) > 0.99
    area = 0.5 * np.abs(normal[:, 0]).sum()
    assert area == pytest.approx(59 * PITCH_Y * (399 * PITCH_Z - 4.0), rel=0.05)


@pytest.mark.parametrize(("down", "across"), [(1.5, 0.0), (0.0, 1.5), (2.5, 0.5)])
def test_a_steep_plane_keeps_its_place_and_area_up_to_its_rims(down, across):
    """With a round hole: its rim is one, too."""

    def plane(y, z):
        steep = 1300.0 + down * y + across * z
        return np.where((y - 20.0) ** 2 + z**2 < 81.0, np.nan, steep)

    made = mesh(cloud(plane, smooth=1))
    x, y, z = made.vertices.T
    assert np.abs(x - 1300.0 - down * y - across * z).max() < 3.0 * 0.17
    corners = made.vertices[made.triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    true_mm2 = (59 * PITCH_Y * 399 * PITCH_Z - np.pi * 81.0) * np.sqrt(1.0 + down**2 + across**2)
    # The hole's edge is anywhere within one pitch.
    assert 0.5 * np.linalg.norm(normal, axis=1).sum() == pytest.approx(true_mm2, rel=0.01)


def test_a_post_of_few_points_stays_in_the_mesh():
    """A post of 6 by 3 mm, 20 mm high, is 0.4 % of the points."""

    def post(y, z):
        return 1300.0 - 20.0 * ((np.abs(y - 20.0) < 3.0) & (np.abs(z) < 1.5))

    made = mesh(cloud(post))
    top = np.abs(made.vertices[made.triangles][:, :, 0] - 1280.0) < 1.0
    assert top.all(axis=1).any()
    assert made.levels[made.chosen].lost < POINTS_MIN <= made.levels[-1].lost
    assert len(made.vertices) < 100


def test_what_cannot_be_meshed_has_one_line():
    points = cloud(ball)
    with pytest.raises(ArgumentError, match="allow more"):
        mesh(points, 0.01)
    with pytest.raises(ArgumentError, match="on one surface"):
        mesh(points[points["column"] % 2 == 0])
    points["y"] = 0.01
    with pytest.raises(ArgumentError, match=r"0 mm along y .*give a sweep"):
        mesh(points)


@pytest.mark.parametrize("form", ["ply", "obj", "stl"])
def test_the_command_writes_a_mesh_that_open3d_reads(tmp_path, form, open3d):
    write_cloud(tmp_path / "c.pcd", cloud(ball))
    target = tmp_path / f"m.{form}"
    arguments = ["mesh", str(tmp_path / "c.pcd"), "--out", str(target)]
    done = CliRunner().invoke(main, [*arguments, "--json"])
    assert done.exit_code == 0, done.output
    facts = json.loads(done.stdout)
    read = open3d.io.read_triangle_mesh(str(target))
    assert len(read.triangles) == facts["levels"][facts["chosen"]]["triangles"]
    assert 1.25 < np.asarray(read.vertices)[:, 0].min() < 1.31
    assert (tmp_path / "m.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        ["c.pcd", target.name, "m.png"]
    )
    printed = "".join(CliRunner().invoke(main, arguments).stdout.split())
    assert "written" in printed
    assert f"{target},{tmp_path / 'm.png'}:" in printed
    bad = CliRunner().invoke(main, [*arguments[:3], str(tmp_path / "m.xyz")])
    assert (bad.exit_code, bad.stdout) == (1, "")


def test_a_cloud_is_not_replaced_by_its_mesh(tmp_path):
    source = tmp_path / "c.ply"
    write_cloud(source, cloud(ball))
    before = source.read_bytes()
    done = CliRunner().invoke(main, ["mesh", str(source), "--out", str(source)])
    assert done.exit_code == 1
    assert done.stderr.count("\n") == 1
    assert f"{source} is the cloud to read; choose another name" in done.stderr
    assert source.read_bytes() == before
