"""`eschorty calibrate --fake`: the laser is off however it ends."""

import re
import signal

import pytest
from click.testing import CliRunner
from logged_command import LoggedCommand

from eschorty_ros.cli import INTERRUPTED, main
from eschorty_ros.core.optics import load_calibration

pytest.importorskip("rclpy", reason="rclpy is not installed")


def calibrate(tmp_path, capture_s, *arguments):
    return LoggedCommand(tmp_path, "calibrate", "--fake", *arguments, capture_s=capture_s)


def test_nine_posts_give_back_a_build_that_is_not_as_designed(tmp_path):
    out = tmp_path / "calibration.yaml"
    with calibrate(tmp_path, 0.5, "--out", out) as command:
        code, stdout, stderr = command.end()
        assert code == 0, stderr
        assert "on" in command.outputs()
        assert command.outputs()[-1] == "off"
    made = load_calibration(out)
    assert made.parameters_fitted is not None
    assert made.id in stdout
    before_mm, after_mm = (
        float(re.search(rf"{name}\s+([\d.]+) mm", stdout)[1]) for name in ("designed", "calibrated")
    )
    assert before_mm > 20.0
    assert after_mm < 1.0
    assert "verdict: identifiable" in stdout
    assert made.id in out.with_suffix(".html").read_text()
    assert out.with_suffix(".png").read_bytes().startswith(b"\x89PNG")


def test_a_signal_ends_it_with_the_laser_off_and_nothing_written(tmp_path):
    out = tmp_path / "calibration.yaml"
    with calibrate(tmp_path, 60.0, "--out", out) as command:
        command.signal_when_on(signal.SIGINT)
        code, _, stderr = command.end()
        assert code == INTERRUPTED, stderr
        assert "Traceback" not in stderr
        assert command.outputs()[-1] == "off"
    assert not out.exists()


def test_posts_that_are_not_there_are_one_line_and_leave_an_old_file(tmp_path):
    out = tmp_path / "calibration.yaml"
    out.write_text("old")
    with calibrate(tmp_path, 0.3, "--distances", "5000,6000,7000", "--out", out) as command:
        code, stdout, stderr = command.end()
        assert code == 1, stderr
        assert stdout == ""
        (line,) = [line for line in stderr.splitlines() if line.startswith("eschorty: ")]
        assert "0 of 3 targets found" in line
        assert command.outputs()[-1] == "off"
    assert out.read_text() == "old"


@pytest.mark.parametrize(
    "arguments", [("targets.csv",), ("--moving", "900"), ("--prior", "b_mm=1"), ("--no-robust",)]
)
def test_options_of_files_are_wrong_usage(tmp_path, arguments):
    (tmp_path / "targets.csv").write_text("row,range_mm\n")
    given = [str(tmp_path / name) if name.endswith(".csv") else name for name in arguments]
    done = CliRunner().invoke(main, ["calibrate", "--fake", *given])
    assert done.exit_code == 2
    assert "--fake takes no" in " ".join(done.output.split())
