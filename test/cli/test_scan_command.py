"""`eschorty scan` over real DDS: cloud, picture, figures; the laser is off however it ends."""

import json
import signal

import numpy as np
import pytest
from click.testing import CliRunner
from logged_command import LoggedCommand

from eschorty_ros.cli import INTERRUPTED, main
from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.core.storage import POINT_DTYPE, read_cloud
from eschorty_ros.report.accuracy import Sweep, measure
from eschorty_ros.simulation.scenes import named

pytest.importorskip("rclpy", reason="rclpy is not installed")

from eschorty_ros.cli.scan import finish
from eschorty_ros.nodes.one_process import scan
from eschorty_ros.nodes.one_process.scan import ScanJob, ScanResult


def test_a_scan_reaches_its_accuracy_and_ends_with_the_laser_off(tmp_path):
    rec = tmp_path / "rec"
    options = ("--stop", 30, "--passes", 2, "--organized", "--out", tmp_path / "scan",
               "--record", rec)  # fmt: skip
    with LoggedCommand(tmp_path, "scan", *options) as command:
        code, stdout, stderr = command.end()
        assert code == 0, stderr
        assert "on" in command.outputs()
        assert command.outputs()[-1] == "off"
    points = read_cloud(tmp_path / "scan" / "scan.pcd")
    made = read_cloud(tmp_path / "scan" / "scan.pcd", organized=True)
    assert made.shape[1] == 1280
    assert 50 <= made.shape[0] <= 60
    build, sweep = load_calibration("config_3"), Sweep(10.0, 30.0, 50.0, 70.0, passes=2)
    measured = measure(points, named("steps"), build.model(), sweep, build.stage_direction)
    print(measured)
    assert measured.completeness >= 0.98
    assert measured.error_median_mm <= 0.7
    assert measured.error_p95_mm <= 2.5
    assert f"{measured.error_median_mm:.3f} mm" in stdout
    assert f"{measured.error_p95_mm:.3f} mm" in stdout
    assert (tmp_path / "scan" / "scan.png").read_bytes().startswith(b"\x89PNG")
    done = CliRunner().invoke(main, ["reconstruct", str(rec), "--json"])
    assert done.exit_code == 0, done.output
    assert "warning" not in done.stderr
    score = json.loads(done.stdout)["score"]
    assert score["error_median_mm"] == pytest.approx(measured.error_median_mm, rel=0.03)
    assert (score["periods"], score["completeness"]) == pytest.approx(
        (measured.periods, measured.completeness), rel=0.01
    )
    cloud = read_cloud(rec / "cloud.pcd")
    assert read_cloud(rec / "cloud.pcd", organized=True).shape == made.shape
    names = ["x", "z", "intensity", "sigma", "column", "flags"]
    common = set(cloud[names].tolist()) & set(points[names].tolist())
    parts = []
    for part in (cloud, points):
        known = np.array([key in common for key in part[names].tolist()])
        # The stage's times are rounded to 1 us: a point at an end may be in or out.
        assert np.abs(np.abs(part["y"][~known] - 0.02) - 0.01).max(initial=0.0) < 2e-7
        parts.append(part[known])
    np.testing.assert_array_equal(parts[0][names], parts[1][names])
    np.testing.assert_allclose(parts[0]["y"], parts[1]["y"], atol=1e-7, rtol=0)
    for command in (["convert", str(rec), str(tmp_path / "bag")],
                    ["reconstruct", str(tmp_path / "bag")],
                    ["info", str(tmp_path / "bag")]):  # fmt: skip
        done = CliRunner().invoke(main, command)
        assert done.exit_code == 0, done.output
        assert done.stderr == "" or "warning" not in done.stderr
    assert "/eschorty/camera/events" in done.stdout
    np.testing.assert_array_equal(read_cloud(tmp_path / "bag" / "cloud.pcd"), cloud)


@pytest.mark.parametrize(
    ("option", "words"),
    [
        (("--stop", "500"), "stop is 500 mm; choose 0 to 220 mm, the stage's travel"),
        (("--speed", "900"), "speed is 900 mm/s; choose 0.05 to 250 mm/s"),
    ],
)
def test_limits_are_checked_in_the_options_unit_before_anything_starts(tmp_path, option, words):
    options = ["scan", "--out", str(tmp_path / "scan"), "--record", str(tmp_path / "rec")]
    done = CliRunner().invoke(main, [*options, *option])
    assert (done.exit_code, done.stderr) == (1, f"eschorty: {words}\n")
    assert not list(tmp_path.iterdir())


def test_a_scan_records_into_a_new_folder_only(tmp_path):
    (tmp_path / "rec").mkdir()
    (tmp_path / "rec" / "mine").touch()
    options = ["scan", "--out", str(tmp_path / "scan"), "--record", str(tmp_path / "rec")]
    done = CliRunner().invoke(main, options)
    assert done.exit_code == 1
    assert "rec: it is not empty" in done.output


@pytest.mark.parametrize(
    ("number", "expected"),
    [
        (signal.SIGINT, INTERRUPTED),
        (signal.SIGTERM, 128 + signal.SIGTERM),
        (signal.SIGHUP, 128 + signal.SIGHUP),
    ],
)
def test_a_signal_ends_the_scan_with_the_laser_off_and_no_traceback(tmp_path, number, expected):
    with LoggedCommand(tmp_path, "scan", "--speed", 2, "--out", tmp_path / "scan") as command:
        command.signal_when_on(number)
        code, _, stderr = command.end()
        assert code == expected, stderr
        assert "Traceback" not in stderr
        assert command.outputs()[-1] == "off"


def test_a_sweep_that_the_scanner_refuses_is_one_line_and_exit_code_1(tmp_path):
    with LoggedCommand(tmp_path, "scan", "--stop", "900", "--out", tmp_path / "scan") as command:
        code, stdout, stderr = command.end()
        assert code == 1, stderr
        assert stdout == ""
        (line,) = [line for line in stderr.splitlines() if line.startswith("eschorty: ")]
        assert "stop" in line
        assert "Traceback" not in stderr
        assert "on" not in command.outputs()


@pytest.mark.parametrize(
    ("option", "value"), [("--scene", "teapot"), ("--calibration", "config_9")]
)
def test_an_unknown_name_is_one_line_before_any_node_starts(tmp_path, option, value):
    out = tmp_path / "scan"
    done = CliRunner().invoke(main, ["scan", option, value, "--out", str(out)])
    assert done.exit_code == 1
    (line,) = done.output.splitlines()
    assert value in line
    assert not out.exists()


def test_options_on_the_command_line_win_over_the_hardware_file(tmp_path, monkeypatch):
    seen = {}

    def started(tables, *_):
        seen.update(tables["reconstruction"])
        raise DeviceError("seen")

    monkeypatch.setattr(scan, "composition", started)
    lab = tmp_path / "lab.yaml"
    lab.write_text(
        "/eschorty/reconstruction:\n"
        "  ros__parameters: {calibration: nominal, keep: good, events_min: 7}\n"
    )
    arguments = ["scan", "--hardware", str(lab), "--out", str(tmp_path / "scan")]
    for given, expected in (([], "nominal"), (["--calibration", "config_3"], "config_3")):
        done = CliRunner().invoke(main, [*arguments, *given])
        assert "seen" in done.output
        assert seen == {"calibration": expected, "keep": "good", "events_min": 7}


def test_a_scan_without_points_is_no_success_and_leaves_an_older_cloud(tmp_path):
    request = ScanJob("leaves", "config_3", 0.0, 20.0, 100.0, 70.0, 0, "paper")
    points = np.empty(0, POINT_DTYPE)
    (tmp_path / "scan.pcd").write_text("older")
    with pytest.raises(DeviceError, match="no points: no events came"):
        finish(
            request,
            ScanResult(True, "no points: no events came", points, 0, 0, 0, 0, "failed", 0.0),
            tmp_path,
        )
    assert (tmp_path / "scan.pcd").read_text() == "older"


def test_what_a_scan_lost_is_printed(tmp_path, capsys):
    request = ScanJob("leaves", "config_3", 0.0, 20.0, 100.0, 70.0, 0, "paper", hardware={})
    points = np.zeros(4, POINT_DTYPE)
    points["x"] = points["t"] = points["y"] = points["column"] = [1, 2, 3, 4]
    lost = "7 points had no stage position"
    finish(request, ScanResult(True, lost, points, 4, 100, 0, 0, "complete", 1.0), tmp_path)
    printed = capsys.readouterr().err
    assert lost in printed
    assert "is replaced" not in printed
    finish(request, ScanResult(True, lost, points, 4, 100, 0, 0, "complete", 1.0), tmp_path)
    assert "scan.pcd of " in capsys.readouterr().err
    # A scan that fails has no picture; that of the older scan does not stay.
    failed = ScanResult(False, "the stage stalled", points, 4, 100, 0, 0, "failed", 0.5)
    with pytest.raises(DeviceError, match=r"the stage stalled \(4 points kept in"):
        finish(request, failed, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["scan.pcd"]


def test_a_recording_without_room_for_its_truth_is_a_warning_below_the_scan(tmp_path, capsys):
    rec, given = tmp_path / "rec", ("--start", 20, "--stop", 21, "--speed", 50, "--out")
    assert CliRunner().invoke(main, list(map(str, ["simulate", *given, rec]))).exit_code == 0
    (rec / "truth.csv").unlink()
    # Nothing can be written in its place.
    (rec / "truth.csv").mkdir()
    points = np.zeros(4, POINT_DTYPE)
    points["x"], points["y"], points["sigma"] = 1.3, 0.0205, 3e-4
    points["column"] = [1, 2, 3, 4]
    request = ScanJob("steps", "config_3", 20.0, 21.0, 50.0, 70.0)
    finish(request, ScanResult(True, "", points, 1, 9, 0, 0, "complete", 1.0, str(rec)), tmp_path)
    printed = capsys.readouterr()
    assert "complete, 100.0%" in printed.out
    assert printed.err.startswith("eschorty: warning: the recording has no truth: ")
    # A disk was full during the sweep.
    (rec / "stage.csv").write_text("")
    full = "recording: no space left on device"
    result = ScanResult(True, full, points, 1, 9, 0, 0, "complete", 1.0, str(rec))
    with pytest.raises(DeviceError, match=f"the recording is not complete: {full}"):
        finish(request, result, tmp_path)


def test_a_scan_that_fails_leaves_no_empty_folders(tmp_path, monkeypatch):
    def fail(*_arguments):
        raise DeviceError("the camera is lost")

    monkeypatch.setattr("eschorty_ros.nodes.one_process.scan.scan_once", fail)
    options = ["scan", "--out", str(tmp_path / "scan"), "--record", str(tmp_path / "rec")]
    done = CliRunner().invoke(main, options)
    assert (done.exit_code, done.stderr.splitlines()[-1]) == (1, "eschorty: the camera is lost")
    assert list(tmp_path.iterdir()) == []
    # An earlier cloud stays.
    (tmp_path / "scan").mkdir()
    (tmp_path / "scan" / "scan.pcd").write_bytes(b"")
    assert "is replaced" not in CliRunner().invoke(main, options).stderr
