"""`eschorty calibrate --fake`: the one-process calibration, and a dark laser however it ends."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from eschorty_ros.cli import INTERRUPTED
from eschorty_ros.core.optics import load_calibration

pytest.importorskip("rclpy", reason="rclpy is not installed")

ROOT = Path(__file__).resolve().parents[2]
DEADLINE_S = 300
LOGGED = """
import functools, sys
from eschorty_ros.nodes.one_process import calibration as nodes
made = nodes.bench_options
log, seconds = sys.argv.pop(1), float(sys.argv.pop(1))
nodes.bench_options = lambda *values: made(*values) | {"laser-log": log}
nodes.CalibrationJob = functools.partial(nodes.CalibrationJob, capture_s=seconds)
from eschorty_ros.cli import main
main(prog_name="eschorty")
"""


@pytest.fixture
def command(tmp_path):
    """Starts the command as a process; the emulated generator logs to `laser.log`."""
    started = []
    environment = {key: value for key, value in os.environ.items() if key != "ROS_DOMAIN_ID"}

    def start(seconds, *arguments):
        process = subprocess.Popen(
            [sys.executable, "-c", LOGGED, str(tmp_path / "laser.log"), str(seconds),
             "calibrate", "--fake", *map(str, arguments)],
            cwd=ROOT,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )  # fmt: skip
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


def outputs(tmp_path):
    """States in the emulated generator's log, in order."""
    log = tmp_path / "laser.log"
    return re.findall(r"\b(on|off)\b", log.read_text().lower()) if log.exists() else []


def test_nine_posts_give_back_a_build_that_is_not_as_designed(command, tmp_path):
    out = tmp_path / "calibration.yaml"
    process = command(0.5, "--out", out)
    stdout, stderr = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 0, stderr
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
    assert outputs(tmp_path)[-1] == "off"
    assert "on" in outputs(tmp_path)


def test_a_signal_ends_it_dark_and_writes_nothing(command, tmp_path):
    process = command(60.0, "--out", tmp_path / "calibration.yaml")
    deadline = time.monotonic() + DEADLINE_S
    while "on" not in outputs(tmp_path):
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < deadline
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == INTERRUPTED, stderr
    assert "Traceback" not in stderr
    assert outputs(tmp_path)[-1] == "off"
    assert not (tmp_path / "calibration.yaml").exists()


def test_posts_that_are_not_there_are_one_line_and_leave_an_old_file(command, tmp_path):
    out = tmp_path / "calibration.yaml"
    out.write_text("old")
    process = command(0.3, "--distances", "5000,6000,7000", "--out", out)
    stdout, stderr = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 1, stderr
    assert stdout == ""
    said = [line for line in stderr.splitlines() if line.startswith("eschorty: ")]
    assert len(said) == 1
    assert "0 of 3 targets found" in said[0]
    assert out.read_text() == "old"
    assert outputs(tmp_path)[-1] == "off"


@pytest.mark.parametrize(
    "arguments", [("targets.csv",), ("--moving", "900"), ("--prior", "b_mm=1"), ("--no-robust",)]
)
def test_what_belongs_to_files_is_wrong_usage(command, tmp_path, arguments):
    (tmp_path / "targets.csv").write_text("row,range_mm\n")
    given = [tmp_path / name if name.endswith(".csv") else name for name in arguments]
    process = command(0.3, *given)
    _, stderr = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 2, stderr
    assert "--fake takes no" in stderr
