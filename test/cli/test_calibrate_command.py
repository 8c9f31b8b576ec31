"""`eschorty calibrate`: from targets and recordings to a file and a page."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import html_check
import numpy as np
import pytest
from calibration_posts import NINE_MM, NOMINAL, TRUTH, TWO_SIZES_MM, range_error_mm, see
from click.testing import CliRunner

from eschorty_ros.cli import main
from eschorty_ros.core.calibration import DISTANCE_COLUMNS, PRIOR_SIGMA, TARGET_COLUMNS
from eschorty_ros.core.optics import load_calibration, save_calibration
from eschorty_ros.core.storage.raw_file import write_events_raw
from eschorty_ros.simulation.scenes import Plane, Posts, bench
from eschorty_ros.simulation.world import simulate_recording

SEED = 16
AS_BUILT = replace(
    NOMINAL, k_prime_px=0.96 * NOMINAL.k_prime_px, b_prime_px=NOMINAL.b_prime_px + 40.0
)
CHECK_MM = np.linspace(800.0, 2100.0, 131)


def run(*arguments):
    return CliRunner().invoke(main, ["calibrate", *map(str, arguments)])


def made_by(out, *arguments):
    done = run(*arguments, "--out", out)
    assert done.exit_code == 0, done.output
    return load_calibration(out)


def rms_mm(calibration, truth):
    error = calibration.model().range_mm(truth.model().row(CHECK_MM)) - CHECK_MM
    return float(np.sqrt(np.mean(error**2)))


@pytest.fixture
def targets_csv(tmp_path):
    targets = see(np.random.default_rng(SEED), size_mm=TWO_SIZES_MM, bloom_px=4.0)
    row = targets.row + 20.0 * (np.arange(9) == 3)
    columns = np.stack([row, NINE_MM, targets.width_px, TWO_SIZES_MM], axis=1)
    path = tmp_path / "targets.csv"
    np.savetxt(path, columns, "%.17g", ",", header="row,range_mm,width_px,size_mm", comments="")
    return path


def test_targets_become_a_calibration_and_a_page(targets_csv, tmp_path):
    out = tmp_path / "made.yaml"
    done = run(targets_csv, "--nominal", "config_3", "--out", out)
    assert done.exit_code == 0, done.output
    assert "rejected: line 5: row" in done.output
    assert "verdict: extrapolates outside 820 to 2050 mm" in done.output
    assert "verdict: identifiable, 3 reservations" in done.output
    assert done.output.count("verdict: ") == 4
    assert "is replaced" not in done.stderr
    assert "made.yaml of 2" in run(targets_csv, "--nominal", "config_3", "--out", out).stderr
    made = load_calibration(out)
    assert np.abs(range_error_mm(made.model())).max() < 3.0
    assert abs(made.k_mm - TRUTH.k_mm) < 3.0 * np.sqrt(made.covariance[0][0]) < 0.3
    page = out.with_suffix(".html")
    assert html_check.faults(page) == []
    # Names may wrap after an underscore.
    text = html_check.text(page).replace("_ ", "_")
    for part in (made.id, "joint", "8 used of 9", "width_bias_px", "prior dominates b_mm",
                 "sigma from the curve of the others", "Magnification"):  # fmt: skip
        assert part in text, part
    assert page.read_text().count("data:image/png;base64,") == 4


@pytest.mark.parametrize(
    ("options", "fitted"),
    [
        (("--method", "paper", "--robust"), ("k_prime_px", "b_prime_px")),
        (("--free=k_prime_px", "--free=b_mm", "--prior=b_mm=none"), ("k_prime_px", "b_mm")),
        (("--free=b_prime_px",), ("b_prime_px",)),
    ],
)
def test_method_and_options_choose_the_fitted_parameters(targets_csv, tmp_path, options, fitted):
    out = tmp_path / "made.yaml"
    made = made_by(out, targets_csv, *options)
    assert made.parameters_fitted == fitted
    assert made.k_mm is None
    assert "b_mm" in fitted or made.b_mm == 0.0
    assert html_check.faults(out.with_suffix(".html")) == []


def test_posts_of_a_recording_give_the_build_back(tmp_path):
    posts = bench()
    simulate_recording(
        tmp_path / "rec", Posts(posts), AS_BUILT, start_mm=10.0, stop_mm=20.0, speed_mm_s=40.0,
        seed=SEED,
    )  # fmt: skip
    distances = ",".join(str(post.range_mm) for post in posts)
    out, options = tmp_path / "made.yaml", (tmp_path / "rec", "--range-sigma", 0.1, "--distances")
    after = rms_mm(made_by(out, *options, f"{distances},"), AS_BUILT)
    before = rms_mm(NOMINAL, AS_BUILT)
    print(f"seed {SEED}: range RMS {after:.2f} mm, {before:.1f} mm before")
    assert after < 1.0 < 20.0 < before
    alone = shutil.copy(tmp_path / "rec" / "events.raw", tmp_path / "posts.raw")
    assert made_by(out, alone, *options[1:], distances) == made_by(out, *options, distances)
    sizes = tmp_path / "posts.csv"
    rows = [f"{post.range_mm},{post.size_mm}" for post in posts]
    sizes.write_text("\n".join(["range_mm,size_mm", *rows]))
    with_sizes = made_by(out, *options, sizes)
    print(f"with sizes {rms_mm(with_sizes, AS_BUILT):.2f} mm, k {with_sizes.k_mm:.3f} mm")
    assert rms_mm(with_sizes, AS_BUILT) < 1.0
    assert with_sizes.k_mm == pytest.approx(AS_BUILT.object_scale_mm, rel=0.01)


def test_posts_that_fit_no_distances_and_events_of_another_sensor_are_one_line(tmp_path):
    folder = tmp_path / "posts"
    folder.mkdir()
    done = run(folder, "--distances", "900,1200,1500", "--out", tmp_path / "made.yaml")
    assert (done.exit_code, done.stderr.count("\n")) == (1, 1)
    assert "missing from the recording is events.raw" in done.stderr
    rows = np.rint(AS_BUILT.model().row([900.0, 1200.0, 1500.0])).astype(int)
    # Three posts of 40 columns and 5 rows, 30 events in each pixel.
    column = np.add.outer(np.array([200, 600, 1000]), np.tile(np.arange(40), 150)).ravel()
    row = np.add.outer(rows, np.repeat(np.arange(-2, 3), 1200)).ravel()
    events = np.arange(row.size), column, row, np.arange(row.size) % 2
    write_events_raw(folder / "events.raw", *events, columns=1280, rows=720)
    for distances, remedy in (
        ("0.9,1.2,1.5", "give millimetres, 785 to 2116"),
        ("930,940,950", "check them"),
    ):
        done = run(folder, "--distances", distances, "--out", tmp_path / "made.yaml")
        assert done.exit_code == 1
        assert f"--distances is {distances}; no post is there; {remedy}" in done.stderr
    write_events_raw(folder / "events.raw", *events, columns=1281, rows=720)
    done = run(folder, "--distances", "900,1200,1500", "--out", tmp_path / "made.yaml")
    assert done.exit_code == 1
    assert "events.raw is of a sensor of 1281 x 720 and config_3 of one of 1280" in done.stderr


def test_a_target_moved_by_the_stage_gives_the_build_back(tmp_path):
    small = {"columns": 48, "principal_column": 23.5}
    nominal, as_built = replace(NOMINAL, **small), replace(AS_BUILT, **small)
    save_calibration(nominal, tmp_path / "nominal.yaml")
    folders = []
    for start, stop in ((10.0, 310.0), (310.0, 10.0)):
        folders.append(tmp_path / f"from_{start:.0f}")
        simulate_recording(
            folders[-1], Plane(1500.0, slope_stage=1.0), as_built, start_mm=start, stop_mm=stop,
            speed_mm_s=200.0, seed=SEED,
        )  # fmt: skip
    options = ("--moving", 1500.0, "--nominal", tmp_path / "nominal.yaml")
    other = tmp_path / "other.yaml"
    save_calibration(replace(nominal, name="bench_2"), other)
    warned = run(*folders, *options[:2], "--nominal", other, "--out", tmp_path / "other_made.yaml")
    assert warned.stderr.count("is of the build config_3 and --nominal of bench_2") == 2
    assert "in one direction only" not in warned.stderr
    one_way = run(folders[0], *options, "--out", tmp_path / "one_way.yaml")
    assert "the stage moves in one direction only" in one_way.stderr
    # The recordings of a new build have no calibration.
    for folder in folders:
        (folder / "calibration.yaml").unlink()
    made = made_by(tmp_path / "made.yaml", *folders, *options)
    error = made.model().range_mm(as_built.model().row([1520.0, 1800.0])) - [1520.0, 1800.0]
    print(f"seed {SEED}: range error {error} mm at 1520 and 1800 mm")
    assert np.abs(error).max() < 1.0
    assert made.columns == 48
    # The error of the target's range, 1 mm by default, is that of all ranges.
    exact, far = (
        made_by(tmp_path / "made.yaml", *folders, *options, "--range-sigma", sigma_mm)
        for sigma_mm in (0.0, 5.0)
    )
    shared = np.subtract(made.covariance, exact.covariance)
    assert shared[1][1] > 0.0
    np.testing.assert_allclose(np.subtract(far.covariance, exact.covariance), 25 * shared, 1e-6)


def test_roll_and_smile_show_in_a_target_moved_by_the_stage(tmp_path):
    small = {"columns": 192, "principal_column": 95.5}
    bent = {"b_prime_1_px": -9.0, "b_prime_2_px": 5.0}
    save_calibration(replace(NOMINAL, **small), tmp_path / "nominal.yaml")
    simulate_recording(
        tmp_path / "rec", Plane(1500.0, slope_stage=1.0), replace(AS_BUILT, **(small | bent)),
        start_mm=10.0, stop_mm=160.0, speed_mm_s=300.0, seed=SEED,
    )  # fmt: skip
    free = [f"--free={name}" for name in ("k_prime_px", "b_prime_px", *bent)]
    options = ("--moving", 1500.0, "--nominal", tmp_path / "nominal.yaml", *free)
    made = made_by(tmp_path / "made.yaml", tmp_path / "rec", *options)
    print(f"seed {SEED}: b'1 {made.b_prime_1_px:.2f} px, b'2 {made.b_prime_2_px:.2f} px")
    assert made.b_prime_1_px == pytest.approx(-9.0, abs=0.2)
    assert made.b_prime_2_px == pytest.approx(5.0, abs=0.5)


# Rows of a target that stays where it is, with noise.
NOT_MOVING = "row,range_mm\n" + "".join(
    f"{300 + 0.3 * noise:.3f},{range_mm:.1f}\n"
    for noise, range_mm in zip(
        np.random.default_rng(1).normal(size=60), np.linspace(900.0, 1500.0, 60), strict=True
    )
)


def test_a_failed_calibration_leaves_the_old_file(targets_csv, tmp_path):
    out = tmp_path / "made.yaml"
    out.write_text("old")
    out.with_suffix(".html").write_text("old page")
    bad = tmp_path / "bad.csv"
    for text, message in (
        ("row,range_mm\n100,900\n101,900\n", "range_mm holds 1 different ranges"),
        ("row,range_mm\n300,1000\n300,1000.2\n300.1,999.9\n", "ranges differ by 0.3 mm"),
        ("row,range_mm\n100,900\n900,1000\n", "row of target line 3 is 900"),
        ("row,range_mm\n100,900\n,1000\n", "line 3: row is empty"),
        ("row,range_mm\n100,900\n100,900\n", "are the same"),
        (NOT_MOVING, "rows 299.2 to 300.6 at 900 to 1500 mm"),
        ("row,range_mm\n500,1000\n300,1300\n100,1500\n", "rows fall with range"),
        ("row;range_mm\n100;900\n", "separate columns by commas"),
        ("row,range_mm\n100,900\n200,1000\n300,1.1\n", "target line 4 is 1.1; give mill"),
    ):
        bad.write_text(text)
        done = run(bad, "--out", out)
        assert (done.exit_code, done.stderr.count("\n")) == (1, 1), done.output
        assert done.stderr.startswith("eschorty: ")
        assert message in done.stderr
    assert (out.read_text(), out.with_suffix(".html").read_text()) == ("old", "old page")
    assert not any(entry.name.endswith("partial") for entry in tmp_path.iterdir())


def test_wrong_usage_is_exit_code_2(targets_csv, tmp_path):
    (tmp_path / "rec").mkdir()
    (tmp_path / "posts.raw").touch()
    for arguments, message in (
        ((tmp_path / "posts.raw", "--moving", 5), "posts.raw has no stage"),
        ((targets_csv, "--distances", "1,2"), "belong to a recording"),
        ((targets_csv, "--prior", "b_mm"), "NAME=SIGMA"),
        ((targets_csv, "--prior", "b_mm=much"), "NAME=SIGMA"),
        ((targets_csv, "--out", tmp_path / "x.txt"), "ending in .yaml"),
        ((targets_csv, "--method", "best"), "'best' is not one of"),
        ((tmp_path / "rec",), "give --distances or --moving"),
        ((tmp_path / "rec", "--distances", "1", "--moving", 5), "give --distances or --moving"),
        ((), "no SOURCE"),
        ((targets_csv, "--as-built", "config_3"), "--as-built belongs to --fake"),
        ((targets_csv, "--range-per-stage", 0.5), "--range-per-stage belongs to --moving"),
        ((tmp_path / "rec", "--moving", 5, "--row-sigma", 1), "is for a targets.csv"),
        (("--fake", "--range-sigma", 2), "--range-sigma belongs to --distances"),
        (("--fake", "--distances", "820,1.2m"), "--distances is 820,1.2m; give millimetres"),
    ):
        done = run(*arguments)
        assert done.exit_code == 2, done.output
        assert message in done.output


def test_the_python_example_of_the_documentation_runs(targets_csv, monkeypatch, capsys):
    page = (Path(__file__).parents[2] / "docs" / "calibration.md").read_text()
    monkeypatch.chdir(targets_csv.parent)
    exec(re.search(r"```python\n(.*?)```", page, re.DOTALL).group(1), {})
    assert "1 of 9 targets rejected: line 5" in capsys.readouterr().out
    assert load_calibration("calibration.yaml").parameters_fitted[0] == "k_mm"


def test_the_documentation_names_every_column_and_prior():
    page = (Path(__file__).parents[2] / "docs" / "calibration.md").read_text()
    for name in (*TARGET_COLUMNS, *DISTANCE_COLUMNS, *PRIOR_SIGMA):
        assert name in page, name
