"""SIGKILL and a full disk at any step of a command: files are complete or absent."""

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "support" / "killed_writes.py"


@pytest.mark.parametrize("command", ["simulate", "reconstruct", "calibrate", "scan"])
def test_a_killed_command_leaves_no_truncated_file(tmp_path, command):
    done = subprocess.run(
        [sys.executable, SCRIPT, command, tmp_path], capture_output=True, text=True, timeout=500
    )
    print(done.stdout)
    assert done.returncode == 0, done.stderr
