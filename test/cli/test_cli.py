"""The commands as a user types them: output, files, exit codes."""

import contextlib
import errno
import gc
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner
from numba.core.event import install_recorder
from streams import words_of
from waiting import wait_until

from eschorty_ros import __version__
from eschorty_ros.cli import COMMANDS, INTERRUPTED, cluster, main
from eschorty_ros.cli.console import pairs, progress_bar, table
from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.core.reconstruction import Settings
from eschorty_ros.core.storage import POINT_DTYPE, load_recording, read_cloud, write_cloud
from eschorty_ros.core.storage.raw_file import RawWriter
from eschorty_ros.simulation.scenes import Plane

ROOT = Path(__file__).resolve().parents[2]
ENDINGS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
NO_ROS = """
import sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("rclpy", "rosidl_runtime_py", "sensor_msgs", "std_msgs"):
            raise ImportError(f"{name} is blocked")
sys.meta_path.insert(0, Blocked())
from eschorty_ros.cli import main
main(prog_name="eschorty")
"""


def run(*arguments):
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def good(*arguments):
    result = run(*arguments)
    assert result.exit_code == 0, result.output
    return result.output


def assert_fails_in_one_line(result, words):
    assert (result.exit_code, result.stdout) == (1, "")
    assert result.stderr.startswith("eschorty: ")
    assert result.stderr.count("\n") == 1
    assert words in result.stderr


def without_ros(*arguments, **environment):
    """The command in a process of its own in which no ROS package can be imported."""
    return subprocess.run(
        [sys.executable, "-c", NO_ROS, *map(str, arguments)], cwd=ROOT, capture_output=True,
        env=os.environ | environment, text=True, timeout=300,
    )  # fmt: skip


@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["design"]])
def test_a_full_disk_is_one_line(arguments, unbuffered):
    with open("/dev/full", "w") as full:
        done = subprocess.run([sys.executable, "-c", "from eschorty_ros.cli import main; main()",
                               *arguments], stdout=full, stderr=subprocess.PIPE, text=True,
                              env=os.environ | {"PYTHONUNBUFFERED": unbuffered},
                              timeout=300)  # fmt: skip
    assert (done.returncode, done.stderr.count("\n")) == (1, 1), done.stderr
    assert "No space left on device" in done.stderr


def test_without_ros_a_scan_is_one_line_that_gives_the_remedy():
    done = without_ros("scan")
    assert (done.returncode, done.stderr.count("\n")) == (1, 1), done.stderr
    assert "make scan" in done.stderr


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A short simulated recording, made by the command itself."""
    folder = tmp_path_factory.mktemp("cli") / "rec"
    done = without_ros("simulate", "--scene", "steps", "--stop", 18, "--seed", 4, "--out", folder)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
def cloud(tmp_path):
    """A flat cloud of five profiles."""
    line, column = (a.ravel() for a in np.mgrid[0:5, 0:200])
    points = np.zeros(line.size, POINT_DTYPE)
    points["x"], points["y"], points["t"] = 1.32, line * 7e-4, line / 70.0
    points["z"], points["column"], points["sigma"] = column * 2.6e-4, column, 7e-4
    points["intensity"] = 20
    write_cloud(tmp_path / "flat.pcd", points)
    return tmp_path / "flat.pcd"


@pytest.mark.parametrize("arguments", [(), *((name,) for name in COMMANDS)])
def test_help_teaches_by_example(arguments):
    output = good(*arguments, "--help")
    assert "Examples:" in output or "Example:" in output
    assert "eschorty" in output


def test_help_imports_nothing_heavy():
    code = (
        "import sys; from eschorty_ros.cli import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'numpy', 'numba', 'matplotlib', 'rclpy', 'yaml'} & set(sys.modules)\n"
        "sys.exit(str(heavy) if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        ("nonsense",),
        ("reconstruct",),
        ("info", "/nowhere"),
        ("simulate", "--frequency", "fast", "--out", "x"),
        ("design", "--theta-prime-deg", "-7", "--far-mm", "2000"),
        ("design", "--wavelength-nm", "905"),
        ("view", __file__, "--browser", "--out", "x.png"),
        ("view", __file__, "--port", "9000"),
        ("scan", "--hardware", __file__, "--scene", "sphere"),
        ("scan", "--port", "9000"),
        ("simulate", "--stop", "nan", "--out", "x"),
        ("simulate", "--stop", "100000", "--out", "x"),
        ("simulate", "--speed", "1e30", "--out", "x"),
        ("convert", __file__, "x", "--packet-period", "9"),
        ("reconstruct", "x", "--stage-speed-mm-s", "9"),
    ],
)
def test_wrong_usage_is_exit_code_2(arguments):
    result = run(*arguments)
    assert result.exit_code == 2
    assert "Traceback" not in result.output


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("--range-min", "1200", "0.0<=x<=1000.0 m."),
        ("--column-first", "5000", "0<=x<=2047 columns."),
        ("--jobs", "many", "'many' is not a valid integer."),
    ],
)
def test_a_refused_number_names_its_unit_and_kind(option, value, words):
    assert words in run("reconstruct", "rec", option, value).output


def test_a_stated_failure_is_one_line_on_stderr_and_exit_code_1(tmp_path):
    assert_fails_in_one_line(run("reconstruct", tmp_path), "events.raw")


@pytest.mark.parametrize(
    "error",
    [OSError(errno.EROFS, "Read-only file system", "out"), OSError(errno.ENOSPC, "No space left"),
     NotADirectoryError(errno.ENOTDIR, "Not a directory", "file/x")],
)  # fmt: skip
def test_any_refusal_of_the_system_is_one_line(monkeypatch, cloud, error):
    def refuse(_path, **_):
        raise error

    monkeypatch.setattr("eschorty_ros.core.storage.cloud.stored_points", refuse)
    result = run("info", cloud)
    assert_fails_in_one_line(result, "eschorty: cannot ")
    assert str(error.strerror) in result.stderr


def test_too_little_memory_is_one_line(monkeypatch, cloud):
    def refuse(_path, **_):
        raise MemoryError("Unable to allocate 9 GiB")

    monkeypatch.setattr("eschorty_ros.core.storage.cloud.stored_points", refuse)
    assert_fails_in_one_line(run("info", cloud), "not enough memory: Unable to allocate 9 GiB; end")


@pytest.mark.parametrize("closed", ["0<&-", "1>&-", "2>&-", "0<&- 1>&- 2>&-"])
def test_a_command_without_standard_streams_does_its_work(recording, tmp_path, closed):
    out = tmp_path / "cloud.pcd"
    done = subprocess.run(
        ["sh", "-c", f'exec "$@" {closed}', "sh", sys.executable, "-c", NO_ROS, "reconstruct",
         recording, "--out", out], cwd=ROOT, capture_output=True, text=True,
    )  # fmt: skip
    assert (done.returncode, "Traceback" in done.stderr) == (0, False), done.stderr
    assert len(read_cloud(out)) > 1000


def test_an_unwritable_output_is_refused_before_the_work(monkeypatch, recording, tmp_path):
    def work(*_arguments):
        raise AssertionError("hours of work before the refusal")

    monkeypatch.setattr("eschorty_ros.core.reconstruction.reconstruct_recording", work)
    result = run("reconstruct", recording, "--out", tmp_path / "missing" / "cloud.pcd")
    assert_fails_in_one_line(result, "cannot write")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("command", "out", "words"),
    [
        ("measure", "a.txt", "choose .png, .pdf or .svg"),
        ("measure", "missing/a.png", "cannot write"),
        ("view", "a.txt", "choose .png, .pdf or .svg"),
        ("view", "missing/a.gif", "cannot write"),
        ("view", "flat.pcd", "choose .png, .pdf or .svg"),
        ("mesh", "a.txt", "choose .ply, .obj, .stl"),
        ("register", "a.txt", "choose .pcd or .ply"),
        ("register", "missing/a.pcd", "cannot write"),
        ("register", "flat.pcd", "is the cloud to read"),
    ],
)
def test_an_output_is_refused_before_a_cloud_is_read(monkeypatch, cloud, command, out, words):
    def work(*_arguments):
        raise AssertionError("work before the refusal")

    monkeypatch.setattr("eschorty_ros.core.storage.read_cloud", work)
    clouds = [cloud] * (2 if command == "register" else 1)
    assert_fails_in_one_line(run(command, *clouds, "--out", cloud.parent / out), words)
    assert list(cloud.parent.iterdir()) == [cloud]


def test_one_bad_output_of_a_design_is_refused_before_the_others_are_written(tmp_path):
    outs = ("--out", tmp_path / "a.yaml", "--out", tmp_path / "a.txt")
    assert_fails_in_one_line(run("design", *outs), "choose .yaml, .png, .pdf or .svg")
    assert list(tmp_path.iterdir()) == []


def test_a_terminal_without_a_degree_sign_still_gets_its_table():
    done = without_ros("design", PYTHONIOENCODING="ascii")
    assert done.returncode == 0, done.stderr
    assert "sheet" in done.stdout


def test_ctrl_c_is_exit_code_130(monkeypatch, cloud):
    def interrupt(_path, **_):
        raise KeyboardInterrupt

    monkeypatch.setattr("eschorty_ros.core.storage.cloud.stored_points", interrupt)
    result = run("info", cloud)
    assert result.exit_code == INTERRUPTED
    assert "interrupted" in result.stderr
    assert "Traceback" not in result.output


def test_simulate_then_reconstruct_without_ros(recording):
    names = {"events.raw", "stage.csv", "laser.yaml", "calibration.yaml", "truth.csv"}
    assert names <= {path.name for path in recording.iterdir()}
    done = without_ros("reconstruct", recording, "--json")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert list(facts) == [
        "events", "dropped_events", "profiles", "periods_per_profile", "points", "seconds",
        "events_per_second", "sigma_median_m", "warnings", "points_without_stage", "counters",
        "score",
    ]  # fmt: skip
    assert facts["warnings"] == []
    assert facts["counters"]["events"] == facts["events"]
    assert facts["score"]["completeness"] > 0.99
    assert facts["score"]["error_median_mm"] < 0.4
    assert "within 1 sigma, 2 sigma" in good("reconstruct", recording)
    points = read_cloud(recording / "cloud.pcd")
    assert facts["points"] == len(points) > 0
    assert facts["profiles"] >= 11  # 8 mm at 50 mm/s and 70 Hz
    assert 1e-4 < facts["sigma_median_m"] < 2e-3


def test_an_empty_cloud_is_a_failure_and_replaces_nothing(recording, tmp_path):
    out = tmp_path / "cloud.ply"
    out.write_text("the last good one")
    for options, words in (((), "events_min = 1000; lower it"), (("--json",), "gives no points")):
        done = run("reconstruct", recording, "--events-min", 1000, "--out", out, *options)
        assert (done.exit_code, out.read_text()) == (1, "the last good one")
        assert words in done.stderr
    facts = json.loads(done.stdout)
    assert (facts["points"], len(facts["warnings"])) == (0, 1)
    assert facts["counters"]["columns_too_few_events"] > 1000


def test_an_option_without_effect_is_refused_with_the_reason(recording, tmp_path):
    out = tmp_path / "cloud.pcd"
    refused = run("reconstruct", recording, "--detail", "off", "--centroid", "mean", "--out", out)
    assert_fails_in_one_line(refused, "detail has no effect while centroid is mean; leave it out")
    assert not out.exists()


def signal_once(number):
    """Return what raises a signal when it is first called; a second may cut a clean-up short."""
    left = [number]
    return lambda: left and signal.raise_signal(left.pop())


@pytest.mark.parametrize("step", ["world.World.advance", "world.recorder.write_truth_csv"])
@pytest.mark.parametrize("number", ENDINGS)
def test_an_interrupted_simulation_leaves_no_half_recording(monkeypatch, tmp_path, step, number):
    def interrupted(*_):
        assert list((tmp_path / "rec").rglob("events.raw"))
        signal.raise_signal(number)

    monkeypatch.setattr(f"eschorty_ros.simulation.{step}", interrupted)
    result = run("simulate", "--stop", 18, "--out", tmp_path / "rec")
    assert result.exit_code == 128 + number
    assert "Traceback" not in result.output
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("number", ENDINGS)
def test_an_interrupted_reconstruction_leaves_nothing(monkeypatch, recording, tmp_path, number):
    interrupt = signal_once(number)

    def interrupted(*_):
        assert list(tmp_path.rglob("points"))
        interrupt()

    monkeypatch.setattr("eschorty_ros.core.reconstruction.offline.place", interrupted)
    result = run("reconstruct", recording, "--out", tmp_path / "cloud.pcd")
    assert result.exit_code == 128 + number
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("number", ENDINGS)
def test_an_interrupted_conversion_leaves_no_half_recording(
    monkeypatch, recording, tmp_path, number
):
    good("convert", recording, tmp_path / "bag")
    write, interrupt = RawWriter.write, signal_once(number)

    def interrupted(writer, data):
        write(writer, data)
        interrupt()

    monkeypatch.setattr(RawWriter, "write", interrupted)
    result = run("convert", tmp_path / "bag", tmp_path / "rec")
    assert result.exit_code == 128 + number
    assert not (tmp_path / "rec").exists()


def test_a_command_goes_on_without_its_terminal_where_sighup_is_ignored(
    monkeypatch, recording, tmp_path
):
    """As `nohup` starts it."""
    monkeypatch.setattr(
        "eschorty_ros.core.storage.write_cloud", lambda *_: signal.raise_signal(signal.SIGHUP)
    )
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        good("reconstruct", recording, "--out", tmp_path / "cloud.pcd")
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_window_stays_open_without_its_terminal_where_sighup_is_ignored(monkeypatch, cloud):
    """Its loop calls no handler of Python."""
    handlers = []
    same = lambda value: value  # noqa: E731
    open3d = SimpleNamespace(
        geometry=SimpleNamespace(PointCloud=same),
        utility=SimpleNamespace(Vector3dVector=same),
        visualization=SimpleNamespace(
            draw_geometries=lambda *_, **__: handlers.append(signal.getsignal(signal.SIGHUP))
        ),
    )
    monkeypatch.setattr("eschorty_ros.simulation.scenes.load_open3d", lambda _: open3d)
    for handler in (signal.SIG_IGN, signal.SIG_DFL):
        before = signal.signal(signal.SIGHUP, handler)
        try:
            good("view", cloud, "--window")
        finally:
            signal.signal(signal.SIGHUP, before)
    assert handlers == [signal.SIG_IGN, signal.SIG_DFL]


def test_simulate_refuses_to_overwrite_a_recording(recording):
    assert_fails_in_one_line(run("simulate", "--out", recording), str(recording))


def test_the_same_seed_gives_the_same_bytes(recording, tmp_path):
    run("simulate", "--scene", "steps", "--stop", 18, "--seed", 4, "--out", tmp_path / "again")
    for name in ("stage.csv", "truth.csv", "laser.yaml"):
        assert (tmp_path / "again" / name).read_bytes() == (recording / name).read_bytes()
    a, b = (folder / "events.raw" for folder in (tmp_path / "again", recording))
    assert a.read_bytes().split(b"% end\n", 1)[1] == b.read_bytes().split(b"% end\n", 1)[1]


def test_reconstruct_offers_every_setting(recording, tmp_path):
    text = good("reconstruct", "--help")
    for name in Settings.__dataclass_fields__:
        assert f"--{name.replace('_', '-')}" in text
    out = tmp_path / "cloud.ply"
    good("reconstruct", recording, "--centroid", "median", "--out", out)
    assert len(read_cloud(out)) > 0
    for bad in (("--centroid", "guess"), ("--events-min", 0), ("--out", tmp_path / "cloud.xyz")):
        assert run("reconstruct", recording, *bad).exit_code == 2, bad
    refused = run("reconstruct", recording, "--packet-period", 4)
    assert (refused.exit_code, "--packet-period is for a bag" in refused.output) == (2, True)


def test_a_calibration_and_a_frequency_stand_in_for_the_recorded_ones(recording, tmp_path):
    out = tmp_path / "cloud.ply"
    good("reconstruct", recording, "--out", out)
    recorded = read_cloud(out)
    good("reconstruct", recording, "--out", out, "--calibration", "nominal")
    other = read_cloud(out)
    np.testing.assert_array_equal(recorded["t"], other["t"])
    assert np.median(np.abs(recorded["x"] - other["x"])) > 1e-3
    done = run("reconstruct", recording, "--out", out, "--frequency", 140)
    assert "given as 140 Hz and the events show 70 Hz; correct it" in done.stderr
    none = good("reconstruct", recording, "--out", out, "--frequency", 1000)
    assert "no point has a known range" in none
    assert "nan" not in none


def test_info_shows_the_content_of_a_recording_and_a_raw_file(recording):
    output = good("info", recording)
    for words in ("config_3", "70 Hz", "ranges", "events/s", "1280 x 720"):
        assert words in output
    assert "peak rate" in good("info", recording / "events.raw")


def test_info_names_the_fit_that_a_recording_was_made_with(recording, tmp_path):
    copy = shutil.copytree(recording, tmp_path / "rec")
    with (copy / "calibration.yaml").open("a") as file:
        file.write("id: config_3-2026-11-30-0a1b2c3d\n")
    assert "config_3-2026-11-30-0a1b2c3d (784.6" in good("info", copy)
    assert "config_3 (784.6" in good("info", copy / "calibration.yaml")


def test_info_names_what_it_shows_where_a_file_is_something_else(tmp_path):
    (tmp_path / "page.html").write_text("<html>")
    result = run("info", tmp_path / "page.html")
    assert_fails_in_one_line(result, "ends in '.html'; give a recording, a file of it, a bag or")


def test_info_counts_the_rising_edges_of_the_trigger_input(tmp_path):
    file = tmp_path / "events.raw"
    words = words_of("8000 6064 002A A001 A000 A001")
    file.write_bytes(b"% evt 3.0\n% geometry 1280x720\n% end\n" + words)
    assert "3 (2 rising)" in good("info", file)


def test_info_warns_of_bytes_that_are_no_events(tmp_path):
    file, noise = tmp_path / "events.raw", np.random.default_rng(3).bytes(20_000)
    file.write_bytes(b"% evt 3.0\n% geometry 1280x720\n% end\n" + noise)
    done = run("info", file)
    assert done.exit_code == 0
    assert "words of the events are not as EVT3 has them" in done.stderr


def test_info_warns_of_a_recording_that_is_cut(recording, tmp_path):
    shutil.copytree(recording, tmp_path / "rec")
    data = (recording / "events.raw").read_bytes()
    (tmp_path / "rec" / "events.raw").write_bytes(data[: len(data) // 16 * 2])
    done = run("info", tmp_path / "rec")
    assert done.exit_code == 0
    assert "the stage moves" in done.stderr
    assert "events.raw is cut: copy it again" in done.stderr
    assert not run("info", recording).stderr
    header = data[: data.index(b"% end\n") + 6]
    (tmp_path / "rec" / "events.raw").write_bytes(header)
    done = run("info", tmp_path / "rec")
    assert done.exit_code == 0
    assert "is cut" not in done.stderr


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("calibration.yaml", ["config_3 (784.6 to 2116.0 mm)", "-37261.86", "1280 x 720"]),
        ("laser.yaml", ["square, 70 Hz", "50000 us"]),
        ("stage.csv", ["10.000 to 18.000 mm", "samples"]),
        ("truth.csv", ["ranges, 1275.0 to"]),
    ],
)
def test_info_reads_every_file_of_a_recording(recording, name, words):
    output = good("info", recording / name)
    for part in words:
        assert part in output


def test_info_gives_the_bounds_of_a_cloud(cloud):
    output = good("info", cloud.rename(cloud.with_suffix(".PCD")))
    assert "1320.000 to 1320.000 mm" in output
    assert "0.700 mm" in output


ODD = [np.nan, np.inf, -np.inf, 3.4e38, 5e-324]


@pytest.mark.parametrize("field", ["x", "z", "t", "sigma", "intensity"])
def test_view_and_info_take_a_cloud_of_odd_numbers(cloud, tmp_path, field):
    points = read_cloud(cloud)
    rng = np.random.default_rng(9)
    points[field][::2] = rng.choice(ODD, len(points[::2])).astype(points[field].dtype)
    odd = tmp_path / "odd$$.ply"
    write_cloud(odd, points)
    seen = run("view", odd)
    assert (seen.exit_code, seen.stdout) == (0, f"{tmp_path / 'odd$$.png'}\n"), seen.output
    assert "of 1,000 points" in seen.stderr or field in ("sigma", "intensity")
    assert "points not finite" in good("info", odd) or field == "sigma"


@pytest.mark.parametrize("value", ["none", *map(str, ODD), "apart"])
def test_view_and_info_take_a_cloud_of_nothing_but_odd_numbers(tmp_path, value):
    points = np.zeros(0 if value == "none" else 9, POINT_DTYPE)
    if value == "apart":
        # A picture of these times and columns has more pixels than memory holds.
        points["t"], points["column"] = [0, 0.01, 0.02, 0.03, 1e8, 0.01, 0.02, 0.03, 0.04], 65535
    elif value != "none":
        for name in ("x", "y", "z", "intensity", "sigma", "t"):
            points[name] = float(value)
    write_cloud(tmp_path / "odd.pcd", points)
    if value == str(ODD[-1]):
        good("view", tmp_path / "odd.pcd")
    else:
        assert_fails_in_one_line(run("view", tmp_path / "odd.pcd"), "; give ")
    good("info", tmp_path / "odd.pcd")


def test_view_writes_a_picture(cloud, tmp_path):
    good("view", cloud)
    assert cloud.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    good("view", cloud, "--out", tmp_path / "flat.gif")
    assert (tmp_path / "flat.gif").read_bytes().startswith(b"GIF89a")
    good("view", cloud, "--out", tmp_path / "flat.svg")
    assert (tmp_path / "flat.svg").stat().st_size > 1000


PCD = """# .PCD v0.7
VERSION 0.7
FIELDS x y z rgb
SIZE 4 4 4 4
TYPE F F F F
COUNT 1 1 1 1
WIDTH 2
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS 2
DATA ascii
1.0 0.1 0.2 0
1.1 0.2 0.4 0
"""
PLY = """ply
format ascii 1.0
element vertex 2
property double x
property double y
property double z
end_header
1.0 0.1 0.2
1.1 0.2 0.4
"""


@pytest.mark.usefixtures("open3d")
@pytest.mark.parametrize(("name", "text"), [("other.pcd", PCD), ("other.ply", PLY)])
def test_view_draws_the_clouds_of_other_programs(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    good("view", tmp_path / name)
    assert (tmp_path / "other.png").read_bytes().startswith(b"\x89PNG")
    (tmp_path / name).write_text("nonsense")
    assert_fails_in_one_line(run("view", tmp_path / name), "no points with x, y and z")


def test_the_version_is_that_of_the_package():
    assert good("--version").split()[-1] == __version__


def test_after_compile_a_first_reconstruction_compiles_nothing(recording):
    assert good("compile").startswith("compiled in")
    with install_recorder("numba:compile") as compiled:
        good("reconstruct", recording)
    assert not compiled.buffer


def test_design_shows_digits_at_any_size():
    row = good("design", "--near-mm", 30, "--far-mm", 40, "--focal-mm", 16).splitlines()[4].split()
    assert row == ["30.0", "0.0", "0.0104", "0.00909", "0.0270", "11.6"]


def test_without_a_terminal_progress_is_a_line_when_it_has_changed(monkeypatch):
    monkeypatch.setattr("eschorty_ros.cli.console.LINE_EVERY_S", 0.01)
    shown = io.StringIO()
    monkeypatch.setattr(sys, "stderr", shown)
    with progress_bar("working") as report:
        for share, note, line in (
            (0.25, "", "working: 25%\n"),
            (1.0, "writing", "working: 99% writing\n"),
        ):
            report(share, note)
            wait_until(lambda line=line: shown.getvalue().endswith(line), line)
        printed = shown.getvalue()
        time.sleep(0.1)
    assert shown.getvalue() == printed


def test_design_prints_the_nominal_build_and_plots_it(tmp_path):
    output = good("design", "--out", tmp_path / "design.png")
    assert "810.5 to 2404.8 mm" in output
    assert "mm/row" in output
    assert (tmp_path / "design.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("command", "name", "pictures"),
    [
        ("design", "made.yaml", ()),
        ("design", "made.svg", ()),
        ("view", "flat.svg", ()),
        ("measure", "step.svg", ()),
        ("mesh", "part.ply", ("part.png",)),
        ("register", "both.pcd", ("both.png",)),
    ],
)
def test_a_command_names_the_results_that_it_replaces(
    monkeypatch, cloud, tmp_path, command, name, pictures
):
    # Meshing and registering need open3d.
    made = SimpleNamespace(rms_sigmas=0.7, vertices=[], triangles=[])
    for function in ("mesh.mesh", "register.register"):
        monkeypatch.setattr(f"eschorty_ros.surfaces.{function}", lambda *_: made)
    monkeypatch.setattr("eschorty_ros.surfaces.register.join", lambda cloud, *_: cloud)
    clouds = {"design": [], "register": [cloud] * 2}.get(command, [cloud])
    results = [tmp_path / name, *(tmp_path / picture for picture in pictures)]
    for path in results:
        path.touch()
    printed = run(command, *clouds, "--out", results[0]).stderr
    for path in results:
        assert re.search(rf"{path} of .* is replaced", printed), printed


def test_a_range_that_may_be_in_metres_is_named_with_the_unit():
    assert "--near-mm is 0.5 mm" in run("design", "--near-mm", 0.5).stderr
    far = run("design", "--far-mm", 1.5).stderr
    assert "--far-mm is 1.5 mm, less than the focal length; ranges are in mm, 1.5 m are 1500" in far
    assert run("design", "--near-mm", 500, "--far-mm", 1500).stderr == ""


def test_design_finds_the_tilt_for_two_ranges():
    assert "sensor -7.6" in good("design", "--near-mm", 784.6, "--far-mm", 2115.9)
    assert run("design", "--near-mm", 900, "--far-mm", 800).exit_code == 1


def test_two_recordings_with_one_target_are_wrong_usage(tmp_path):
    for name in ("a.mcap", "a.db3"):
        (tmp_path / name).write_bytes(b"")
    done = run("reconstruct", tmp_path / "a.mcap", tmp_path / "a.db3")
    assert done.exit_code == 2
    assert "would be written to" in done.output


@pytest.mark.parametrize("where", ["here", "cluster"])
def test_a_bad_recording_does_not_end_the_others(recording, tmp_path, where):
    """Two good ones around one with a broken file; the clouds of a cluster are those made here."""
    good("reconstruct", recording)
    expected = (recording / "cloud.pcd").read_bytes()
    folders = [tmp_path / name for name in ("a", "bad", "b")]
    for folder in folders:
        shutil.copytree(recording, folder, ignore=shutil.ignore_patterns("cloud.pcd"))
    (folders[1] / "events.raw").write_bytes(b"% evt 2.0\n% end\n\0\0")
    options = ["--json"]
    with contextlib.ExitStack() as stack:
        if where == "cluster":
            distributed = pytest.importorskip("distributed", reason="distributed is not installed")
            local = distributed.LocalCluster(
                n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None
            )
            options += ["--dask", stack.enter_context(local).scheduler_address]
        done = run("reconstruct", *folders, *options)
    assert done.exit_code == 1
    facts = {Path(line["recording"]): line for line in map(json.loads, done.stdout.splitlines())}
    assert set(facts) == set(folders)
    assert "not EVT3" in facts[folders[1]]["error"]
    assert "1 of 3 recordings failed" in done.stderr
    for folder in (folders[0], folders[2]):
        assert facts[folder]["points"] > 0
        assert (folder / "cloud.pcd").read_bytes() == expected


def test_a_narrow_terminal_cuts_no_number():
    from rich.console import Console

    made = table("distances", *("name", *"abcde"))
    made.add_row("surface 1", *["-1320.017 ± 0.123"] * 5)
    console = Console(file=io.StringIO(), width=80)
    console.print(made)
    text = console.file.getvalue()
    assert ("…" in text, text.count("-1320.017")) == (False, 5)


def test_a_path_longer_than_a_table_is_one_line(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "20")
    pairs("a/recording[bold]/of/long.raw", {"events": "5"})
    assert "a/recording[bold]/of/long.raw\n" in capsys.readouterr().out


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nowhere.invalid", "tcp://:x"])
def test_a_scheduler_that_does_not_answer_is_one_line(address, monkeypatch, capsys):
    pytest.importorskip("distributed", reason="distributed is not installed")
    monkeypatch.setattr(cluster, "_CONNECT_S", 0.3)
    with pytest.raises(DeviceError, match="no dask scheduler answers"):
        next(cluster.on_cluster(address, print, [()]))
    assert capsys.readouterr().err == f"connecting to {address}, for up to 0.3 s\n"
    # A client that is left would warn here.
    gc.collect()


def test_simulate_prints_how_a_scene_is_moved_into_the_range_of_a_build(tmp_path):
    near = tmp_path / "near.yaml"
    good("design", "--focal-mm", "8", "--near-mm", "300", "--far-mm", "1000", "--out", near)
    sweep = ("--start", "0", "--stop", "1", "--out", tmp_path / "rec")
    said = good("simulate", "--scene", "plane", "--calibration", near, *sweep)
    offset_mm, factor = re.search(r"ranges +(\S+) mm \+ (\S+) x", said).groups()
    recording = load_recording(tmp_path / "rec")
    scene_mm = Plane().range_mm(0.0, 0, recording.calibration.model())
    expected_mm = float(offset_mm) + float(factor) * scene_mm
    assert np.allclose(recording.truth["range_mm"], expected_mm, atol=0.1)
