"""README: its Python example runs, its tables name what exists."""

import ast
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()


def test_the_python_example_runs(tmp_path):
    code = re.search(r"```python\n(.*?)```", README, re.DOTALL).group(1)
    environment_code = (
        f"import sys; sys.path.insert(0, {str(ROOT)!r})\n"
        "from eschorty_ros.core.calibration import load_calibration\n"
        "from eschorty_ros.simulation.recorder import simulate_recording\n"
        "from eschorty_ros.simulation.scene import named\n"
        "simulate_recording('rec', named('steps'), load_calibration('config_3'), stop_mm=14.0)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", environment_code + code],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert done.returncode == 0, done.stderr
    assert "points" in done.stdout
    assert (tmp_path / "rec" / "cloud.ply").stat().st_size > 10_000


def test_every_launch_argument_is_in_the_table_with_its_default():
    tree = ast.parse((ROOT / "launch" / "scan.launch.py").read_text())
    table = next(
        node.value
        for node in tree.body
        if isinstance(node, ast.Assign) and node.targets[0].id == "ARGUMENTS"
    )
    for row in table.elts:
        name, default = row.elts[0].value, row.elts[1]
        line = next(line for line in README.splitlines() if re.match(rf"\| .*`{name}`", line))
        if isinstance(default, ast.Constant):
            assert f"`{default.value}`" in line


def test_links_and_the_picture_exist():
    for document in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")):
        for target in re.findall(r"\]\(([^)#]+)\)", document.read_text()):
            assert (document.parent / target).exists(), f"{document.name}: {target}"
    assert (ROOT / "docs" / "scan.png").stat().st_size < 500_000


def test_every_command_it_shows_exists():
    from eschorty_ros.cli import COMMANDS

    shown = set(re.findall(r"^    eschorty (\w+)", README, re.MULTILINE))
    assert shown
    assert shown <= set(COMMANDS)
