"""SIGKILL and a full disk at any step of a command: files are complete or absent."""

import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[1] / "support" / "killed_writes.py"


def test_a_killed_command_leaves_no_truncated_file(tmp_path):
    done = subprocess.run(
        [sys.executable, SCRIPT, tmp_path], capture_output=True, text=True, timeout=500
    )
    print(done.stdout)
    assert done.returncode == 0, done.stderr
