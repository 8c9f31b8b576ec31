"""Planes in clouds: true values within the reported sigmas, and answers where there is no plane."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from grid_clouds import PITCH_Y, PITCH_Z, cloud

import eschorty_ros as es
from eschorty_ros.cli import main
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.core.storage import write_cloud
from eschorty_ros.core.storage.cloud import SENSOR_EDGE
from eschorty_ros.simulation.scenes import Steps
from eschorty_ros.simulation.world import simulate_recording
from eschorty_ros.surfaces.measure import Region, faults, measure, parse_region

ALL = (-np.inf, np.inf)


def test_the_sigmas_of_simulated_levels_cover_the_truth(tmp_path):
    """Four levels at random ranges, 20 mm of sweep each; seeds 0 to 5."""
    build = load_calibration("config_3")
    ratios, flat = {name: [] for name in ("range", "slope", "distance", "flush")}, []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        base_mm, levels_mm = rng.uniform(1250.0, 1400.0), tuple(rng.uniform(-60.0, 60.0, 4))
        recording = simulate_recording(
            tmp_path / str(seed), Steps(base_mm, levels_mm, (0.0,)), build,
            modulation=Modulation(70.0), start_mm=10.0, stop_mm=30.0, speed_mm_s=50.0, seed=seed,
        )  # fmt: skip
        regions = tuple(Region((320 * k + 10, 320 * k + 309), ALL) for k in range(4))
        found = measure(es.reconstruct(recording).points, regions)
        for surface, level_mm in zip(found.surfaces, levels_mm, strict=True):
            value = surface.range_mm
            ratios["range"].append((value.value - base_mm - level_mm) / value.sigma)
            slopes = [surface.plane.slope(axis) for axis in (0, 1)]
            ratios["slope"] += [slope.value / slope.sigma for slope in slopes]
            flat.append(surface.flat.value_mm.value / surface.flat.of_plane_mm)
        for pair, level_mm in zip(found.pairs, levels_mm[1:], strict=True):
            for name, value in (("distance", pair.distance_mm), ("flush", pair.flush_mm)):
                ratios[name].append((value.value - level_mm + levels_mm[0]) / value.sigma)
    # A flat level is as flat as noise lets a perfect plane look, but for the pixels' fixed pattern.
    assert np.mean(flat) < 2.0
    assert np.max(flat) < 3.0
    for name, values in ratios.items():
        inside = [np.mean(np.abs(values) < sigmas) for sigmas in (1.0, 2.0)]
        print(name, len(values), *np.round(inside, 2))
        assert 0.5 <= inside[0] <= 0.97, name
        assert inside[1] >= 0.85, name


@pytest.mark.parametrize("smooth", [1, 5, 17])
def test_the_sigma_of_a_plane_follows_the_errors_that_neighbours_share(smooth):
    """Slopes of 40 noisy planes scatter as their sigmas state, with and without smoothing."""
    planes = [
        measure(cloud(lambda y, z: 1300.0 + 0.2 * y - 0.1 * z, smooth=smooth, seed=seed),
                (Region(ALL, ALL),), 0.0).surfaces[0].plane for seed in range(40)
    ]  # fmt: skip
    for axis, true in ((0, 0.2), (1, -0.1)):
        slopes = [plane.slope(axis) for plane in planes]
        stated = np.sqrt(np.mean([slope.sigma**2 for slope in slopes]))
        seen = np.sqrt(np.mean([(slope.value - true) ** 2 for slope in slopes]))
        assert 0.75 < seen / stated < 1.3, axis


@pytest.mark.parametrize(("left", "right"), [(0.0, 0.2), (0.0, 1.0), (0.0, 5.0), (-1.0, 1.0)])
def test_the_sigma_of_an_angle_holds_for_steep_planes_too(left, right):
    """Angles of 40 pairs of planes of different slopes scatter as their sigmas state."""
    true = np.degrees(np.arctan(right) - np.arctan(left))
    parts = (parse_region(":180,:"), parse_region("220:,:"))
    angles = []
    for seed in range(40):
        points = cloud(lambda y, z: 1300.0 + np.where(z < 0.0, left, right) * z, seed=seed)
        angles.append(measure(points, parts, 0.0).pairs[0].angle_deg)
    off = np.array([angle.value - true for angle in angles])
    stated = np.sqrt(np.mean([angle.sigma**2 for angle in angles]))
    assert 0.75 < np.sqrt(np.mean(off**2)) / stated < 1.3


def test_small_parts_of_a_plane_are_no_bent_ones():
    """The pixels' pattern, the same in every period and alike in 17 columns; seeds 0 to 11."""
    parts, bent = (Region((100, 299), (5.0, 25.0)), Region((100, 214), (5.0, 15.0))), 0
    for seed in range(12):
        noise = np.random.default_rng(seed).normal(0.0, 0.15 * np.sqrt(17.0), 416)
        pattern = np.convolve(noise, np.full(17, 1.0 / 17.0), "valid")
        points = cloud(lambda y, z, p=pattern: 1300.0 + p + 0.0 * y, 0.08, smooth=17, seed=seed)
        points["sigma"] = 0.17e-3
        flats = [surface.flat for surface in measure(points, parts).surfaces]
        bent += sum(flat.of_no_plane for flat in flats)
        assert np.isfinite([flat.of_plane_mm for flat in flats]).tolist() == [True, False]
    assert bent == 0


@pytest.mark.parametrize("deep_mm", [0.5, 3.0, 30.0])
def test_the_flatness_of_a_plane_holds_its_pocket_however_deep(deep_mm):
    """A pocket of 10 by 15 mm is form; points that are alone beside the plane are none."""

    def plate(y, z):
        alone = np.random.default_rng(3).random(np.broadcast(y, z).shape) < 0.05
        pocket = (np.abs(y - 20.0) < 5.0) & (np.abs(z - 20.0) < 7.5)
        return 1300.0 + 0.2 * y + 0.0 * z + np.where(alone, 50.0, 0.0) + deep_mm * pocket

    flat = measure(cloud(plate), (Region(ALL, ALL),)).surfaces[0].flat
    cosine = 1.0 / np.hypot(1.0, 0.2)
    # Noise of the cells adds to peak and valley.
    off_mm = flat.value_mm.value - deep_mm * cosine
    assert abs(off_mm) < flat.of_plane_mm + flat.value_mm.sigma
    assert flat.of_no_plane


def test_a_form_finer_than_the_cells_has_a_line_and_so_have_sigmas_that_are_too_large():
    (ripple,) = faults(measure(cloud(lambda y, z: 1300.0 + 0.5 * np.sin(z / 2.0) + 0.0 * y)))
    assert "surface 1: residuals are" in ripple
    assert "times the points' own sigmas; it has a form finer" in ripple
    flat = cloud(lambda y, z: 1300.0 + 0.0 * y * z)
    assert faults(measure(flat)) == []
    flat["sigma"] *= 3.0
    (large,) = faults(measure(flat))
    assert "of the points' own sigmas, which are too large" in large


def test_regions_of_one_plate_have_no_gap_between_them():
    plate = cloud(lambda y, z: np.where(z < 0.0, 1300.0, 1301.0) + 0.0 * y)
    regions = (Region((20, 140), ALL), Region((260, 380), ALL))
    pair = measure(plate, regions).pairs[0]
    assert np.isnan(pair.gap_mm.value)
    assert abs(pair.flush_mm.value - 1.0) < 4.0 * pair.flush_mm.sigma
    apart = plate[(plate["column"] < 141) | (plate["column"] > 259)]
    gap_mm = measure(apart, regions).pairs[0].gap_mm
    assert abs(gap_mm.value - 119 * PITCH_Z) < 4.0 * gap_mm.sigma


def test_surfaces_gap_step_and_flatness_are_found_without_regions():
    """Two panels, 10 mm apart along z, one 4 mm farther and with a dent of 1.5 mm."""

    def panels(y, z):
        dent = 1.5 * np.exp(-((y - 20.0) ** 2 + (z - 30.0) ** 2) / 72.0)
        right = 1304.0 + dent
        return np.where(z < 0.0, 1300.0, np.where(z < 10.0, np.nan, right)) + 0.05 * y

    found = measure(cloud(panels))
    assert len(found.surfaces) == 2
    pair = found.pairs[0]
    sign = 1.0 if found.surfaces[0].part.column.mean() < 200 else -1.0
    assert abs(pair.flush_mm.value - sign * 4.0) < 3.0 * pair.flush_mm.sigma + 0.1
    assert pair.flush_mm.sigma < 0.2
    # The rims that the planes leave out are part of the panels.
    assert pair.gap_mm.value == pytest.approx(10.0, abs=0.4)
    flat = {surface.part.column.mean() < 200: surface.flat for surface in found.surfaces}
    assert 0.8 < flat[False].value_mm.value < 1.5
    assert flat[False].value_mm.value > 3.0 * flat[False].of_plane_mm
    assert flat[True].value_mm.value < 2.0 * flat[True].of_plane_mm
    regions = (parse_region("0:199,:"), parse_region("240:,:"))
    assert measure(cloud(panels), regions).pairs[0].gap_mm.value == pytest.approx(10.0, abs=0.4)


@pytest.mark.parametrize("step_mm", [2.0, 4.0])
@pytest.mark.parametrize(("axis", "gap_mm"), [("z", 0.0), ("z", 3.0), ("y", 0.0), ("y", 7.0)])
def test_the_gap_of_surfaces_found_is_that_of_their_edges(step_mm, axis, gap_mm):
    def panels(y, z):
        place = z if axis == "z" else y - 15.0
        behind = np.where(place < gap_mm, np.nan, 1300.0 + step_mm)
        return np.where(place < 0.0, 1300.0, behind) + 0.0 * (y + z)

    found = measure(cloud(panels))
    assert len(found.surfaces) == 2
    gap = found.pairs[0].gap_mm
    # Each edge is anywhere within one pitch.
    assert abs(gap.value - gap_mm) <= {"z": PITCH_Z, "y": PITCH_Y}[axis]
    assert gap.sigma < 0.5


def test_a_cloud_without_surfaces_and_bad_regions_have_one_line():
    points = cloud(lambda y, z: 1300.0 + 0.0 * z)
    for text in ("100-400", "400:100,:"):
        with pytest.raises(ArgumentError, match="low to high; write it as 100:400,20:60"):
            parse_region(text)
    with pytest.raises(ArgumentError, match=r"surface 2 has 0 points .* a region with 30 points"):
        measure(points, (parse_region(":100,:"), parse_region("1000:,:")))
    with pytest.raises(ArgumentError, match="give a cloud of a sweep"):
        measure(points[points["t"] == 0.0])
    points["flags"] = SENSOR_EDGE
    with pytest.raises(ArgumentError, match=r"24,000 more with the flag mixed or sensor_edge"):
        measure(points)
    points["flags"] = 0
    points["x"] = np.random.default_rng(0).uniform(1.0, 2.0, len(points))
    with pytest.raises(ArgumentError, match="choose regions"):
        measure(points)


def test_a_cloud_of_a_stage_at_rest_has_one_line(tmp_path):
    points = cloud(lambda y, z: 1300.0 + 0.0 * z)
    points["y"] = 0.01
    write_cloud(tmp_path / "rest.ply", points)
    write_cloud(tmp_path / "one.ply", points[points["t"] == points["t"][0]])
    for name, command in (
        ("rest", ["measure"]),
        ("one", ["view", "--out", str(tmp_path / "one.gif")]),
    ):
        done = CliRunner().invoke(main, [*command, str(tmp_path / f"{name}.ply")])
        assert done.exit_code == 1, done.output
        assert done.stderr.startswith("eschorty: ")
        assert done.stderr.count("\n") == 1


def test_the_command_prints_values_with_their_sigma(tmp_path, monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    write_cloud(tmp_path / "c.ply", cloud(lambda y, z: np.where(z < 0, 1300.0, 1310.0)))
    arguments = ["measure", str(tmp_path / "c.ply"), "--out", str(tmp_path / "c.png")]
    done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 0, done.output
    assert "flatness mm" in done.output
    assert "gap mm" in done.output
    assert done.stderr == ""
    assert (tmp_path / "c.png").read_bytes().startswith(b"\x89PNG")
    facts = json.loads(CliRunner().invoke(main, [*arguments[:2], "--json"]).stdout)
    distance = facts["pairs"][0]["distance_mm"]
    assert abs(abs(distance["value"]) - 10.0) < 4.0 * distance["sigma"] < 1.0
    # A region of few cells has no flatness.
    narrow = CliRunner().invoke(main, [*arguments[:2], "--region", "20:25,:10"])
    assert narrow.stdout.count(" - ") == 2
    # Nor is a surface with a fold of 1 mm a plane.
    write_cloud(tmp_path / "bent.ply", cloud(lambda y, z: 1300.0 + 0.1 * np.abs(y - y.mean())))
    bent = CliRunner().invoke(main, ["measure", str(tmp_path / "bent.ply")])
    assert "warning: no plane: 1, by flatness" in bent.stderr
    # The same columns twice overlap: there is no gap.
    twice = [*arguments[:2], "--json", *["--region", "20:140,:"] * 2]
    done = CliRunner().invoke(main, twice)
    assert '"gap_mm": {"value": null' in done.stdout
    assert CliRunner().invoke(main, [*arguments[:2], "--common-mm", "nan"]).exit_code == 2
