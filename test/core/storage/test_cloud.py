"""Clouds go through both file forms unchanged; other programs read them too."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eschorty_ros.core.base.errors import ArgumentError, FormatError
from eschorty_ros.core.storage import POINT_DTYPE, Points, height_map, read_cloud, write_cloud

EXTENSIONS = [".pcd", ".ply"]


def cloud(count: int, seed: int = 7) -> Points:
    rng = np.random.default_rng(seed)
    points = np.zeros(count, POINT_DTYPE)
    for name in ("x", "y", "z", "intensity", "sigma"):
        points[name] = rng.normal(1.0, 0.5, count)
    points["t"] = 1e6 + np.arange(count) * 1e-6
    points["column"] = rng.integers(0, 1280, count)
    return points


def coordinates(points: Points) -> np.ndarray:
    return np.stack([points[name] for name in "xyz"], axis=1).astype(np.float64)


def test_point_layout():
    assert POINT_DTYPE.names == ("x", "y", "z", "intensity", "sigma", "t", "column", "flags")
    assert POINT_DTYPE.itemsize == 32
    kinds = [POINT_DTYPE[name].str for name in POINT_DTYPE.names]
    assert kinds == ["<f4"] * 5 + ["<f8", "<u2", "<u2"]


@pytest.mark.parametrize(
    ("extension", "lines"),
    [
        (".pcd", [(b" flags", b""), (b" 2\nTYPE", b"\nTYPE"), (b" U U\n", b" U\n"),
                  (b" 1 1\nWIDTH", b" 1\nWIDTH")]),
        (".ply", [(b"property uint16 flags\n", b"")]),
    ],
)  # fmt: skip
def test_a_cloud_written_before_there_were_flags_has_good_points(tmp_path, extension, lines):
    file, points = tmp_path / f"cloud{extension}", cloud(20)
    write_cloud(file, points)
    head = file.read_bytes()[: -points.nbytes]
    for new, old in lines:
        assert head.count(new) == 1
        head = head.replace(new, old)
    names = list(points.dtype.names[:-1])
    old_points = np.zeros(20, [(name, POINT_DTYPE[name]) for name in names])
    for name in names:
        old_points[name] = points[name]
    file.write_bytes(head + old_points.tobytes())
    assert read_cloud(file).tobytes() == points.tobytes()


@pytest.mark.parametrize("extension", [*EXTENSIONS, ".PCD"])
@pytest.mark.parametrize("count", [0, 1, 10_000])
def test_round_trip_is_bit_exact(tmp_path, extension, count):
    file = tmp_path / f"cloud{extension}"
    write_cloud(file, cloud(count))
    back = read_cloud(str(file))
    assert back.dtype == POINT_DTYPE
    assert back.tobytes() == cloud(count).tobytes()
    back["x"] = 0.0
    assert [entry.name for entry in tmp_path.iterdir()] == [file.name]


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_nan_and_strided_points_survive(tmp_path, extension):
    points = cloud(20)
    points["x"][3] = np.nan
    points["sigma"][4] = np.inf
    write_cloud(tmp_path / f"c{extension}", points[::2])
    assert read_cloud(tmp_path / f"c{extension}").tobytes() == points[::2].tobytes()


def test_a_height_map_is_organised_in_pcd_and_its_points_read_everywhere(tmp_path, open3d):
    """As PCL has it: HEIGHT profiles, WIDTH columns, NaN where nothing is."""
    rng = np.random.default_rng(3)
    profile, column = np.nonzero(rng.random((9, 40)) < 0.7)
    points = cloud(len(profile))
    points["column"] = column
    order = rng.permutation(len(points))
    made = height_map(points[order], 100 + 5 * profile[order], 40)
    assert made.shape == (9, 40)
    assert np.isnan(made[["x", "sigma", "t"]].tolist()).all(axis=-1).sum() == 360 - len(points)
    np.testing.assert_array_equal(made[profile, column], points)
    for name in ("map.pcd", "map.ply"):
        write_cloud(tmp_path / name, made)
        np.testing.assert_array_equal(read_cloud(tmp_path / name), points)
    head = (tmp_path / "map.pcd").read_bytes()[:400].decode("ascii", "replace")
    assert "WIDTH 40\nHEIGHT 9\n" in head
    assert "POINTS 360\n" in head
    assert read_cloud(tmp_path / "map.pcd", organized=True).tobytes() == made.tobytes()
    with pytest.raises(FormatError, match=r"map.ply: its points are no height map; .*organized"):
        read_cloud(tmp_path / "map.ply", organized=True)
    seen = np.asarray(open3d.io.read_point_cloud(str(tmp_path / "map.pcd")).points)
    np.testing.assert_array_equal(seen[np.isfinite(seen[:, 0])], coordinates(points))


def test_two_points_of_a_cell_and_columns_beyond_the_sensor_are_refused():
    for columns, words in ((40, "two points"), (1, "column 1 and columns is 1")):
        points = cloud(2)
        points["column"] = columns > 1, 1
        with pytest.raises(ArgumentError, match=words):
            height_map(points, np.zeros(2, int), columns)


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_open3d_sees_the_same_points(tmp_path, extension, open3d):
    file = tmp_path / f"cloud{extension}"
    points = cloud(1000)
    write_cloud(file, points)
    expected = coordinates(read_cloud(file))
    assert np.array_equal(expected, coordinates(points))
    assert np.array_equal(np.asarray(open3d.io.read_point_cloud(str(file)).points), expected)
    tensor = open3d.t.io.read_point_cloud(str(file)).point
    assert np.array_equal(tensor["positions"].numpy(), expected)
    # Open3D's PLY reader skips 16-bit properties.
    for name in ("intensity", "sigma", "t", *(["column"] if extension == ".pcd" else [])):
        assert np.array_equal(tensor[name].numpy().ravel(), points[name]), name


def test_headers_as_written(tmp_path):
    points = cloud(2)
    write_cloud(tmp_path / "c.pcd", points)
    write_cloud(tmp_path / "c.ply", points)
    assert (tmp_path / "c.pcd").read_bytes()[: -points.nbytes].decode() == (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        "FIELDS x y z intensity sigma t column flags\nSIZE 4 4 4 4 4 8 2 2\nTYPE F F F F F F U U\n"
        "COUNT 1 1 1 1 1 1 1 1\nWIDTH 2\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA binary\n"
    )
    assert (tmp_path / "c.ply").read_bytes()[: -points.nbytes].decode() == (
        "ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty float x\n"
        "property float y\nproperty float z\nproperty float intensity\nproperty float sigma\n"
        "property double t\nproperty uint16 column\nproperty uint16 flags\nend_header\n"
    )


def test_a_ply_file_with_another_name_of_its_type_is_read(tmp_path):
    file, points = tmp_path / "c.ply", cloud(7)
    write_cloud(file, points)
    file.write_bytes(file.read_bytes().replace(b"property uint16 ", b"property ushort "))
    np.testing.assert_array_equal(read_cloud(file), points)


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_truncated_or_longer_files_are_refused(tmp_path, extension):
    file = tmp_path / f"c{extension}"
    write_cloud(file, cloud(5))
    complete = file.read_bytes()
    shorter = [complete[:cut] for cut in (*range(0, len(complete), 7), -1)]
    for data in (*shorter, complete + b"\0"):
        file.write_bytes(data)
        with pytest.raises(FormatError, match=file.name) as caught:
            read_cloud(file)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("extension", EXTENSIONS)
@pytest.mark.parametrize(
    ("old", "new"),
    [(b"sigma", b"curvature"), (b"DATA binary", b"DATA ascii"), (b"WIDTH 5", b"WIDTH 6"),
     (b"binary_little_endian", b"ascii"), (b"POINTS 5", b"POINTS -5"), (b"vertex 5", b"vertex X")],
)  # fmt: skip
def test_other_layouts_are_refused(tmp_path, extension, old, new):
    file = tmp_path / f"c{extension}"
    write_cloud(file, cloud(5))
    data = file.read_bytes()
    if old not in data:
        assert read_cloud(file).size == 5
        return
    file.write_bytes(data.replace(old, new))
    with pytest.raises(FormatError, match=file.name):
        read_cloud(file)


@settings(derandomize=True, max_examples=200, deadline=None)
@given(st.sampled_from(EXTENSIONS), st.binary(max_size=200), st.integers(0, 400))
def test_random_damage_never_ends_in_anything_but_a_stated_failure(
    tmp_path_factory, extension, noise, at
):
    file = tmp_path_factory.mktemp("noise") / f"c{extension}"
    write_cloud(file, cloud(3))
    data = bytearray(file.read_bytes())
    data[at : at + len(noise)] = noise
    file.write_bytes(data)
    try:
        points = read_cloud(file)
    except FormatError:
        return
    assert points.dtype == POINT_DTYPE


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    file = tmp_path / "c.pcd"
    write_cloud(file, cloud(3))

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(ArgumentError, match="No space left"):
        write_cloud(file, cloud(9))
    assert read_cloud(file).size == 3
    assert [entry.name for entry in tmp_path.iterdir()] == ["c.pcd"]


def test_missing_files_and_other_extensions_are_named(tmp_path):
    with pytest.raises(FormatError, match=r"cannot read .*gone\.pcd"):
        read_cloud(tmp_path / "gone.pcd")
    with pytest.raises(FormatError, match=r"is a folder; give a cloud, such as .*cloud\.pcd"):
        read_cloud(tmp_path)
    for use in (partial(write_cloud, points=cloud(1)), read_cloud):
        with pytest.raises(ArgumentError, match=r"\.xyz"):
            use(tmp_path / "c.xyz")
