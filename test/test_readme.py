"""README: its Python examples run, its tables name what exists."""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()


def test_the_python_examples_run(tmp_path):
    code = "".join(re.findall(r"```python\n(.*?)```", README, re.DOTALL))
    environment_code = (
        f"import sys; sys.path.insert(0, {str(ROOT)!r})\n"
        "from eschorty_ros.core.optics.calibration_file import load_calibration\n"
        "from eschorty_ros.simulation.world.recorder import simulate_recording\n"
        "from eschorty_ros.simulation.scenes.names import named\n"
        "simulate_recording('rec', named('steps'), load_calibration('config_3'), stop_mm=14.0)\n"
        "import pathlib, shutil; pathlib.Path('mine').mkdir()\n"
        "shutil.copy('rec/events.raw', 'mine')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", environment_code + code + "es.load_recording('mine')\n"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert "points" in done.stdout
    assert (tmp_path / "rec" / "cloud.ply").stat().st_size > 10_000


def anchors(page):
    """Names that headings of a page are linked by."""
    titles = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def test_links_and_the_picture_exist():
    for document in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")):
        for target, anchor in re.findall(r"\]\(([^)#]*)#?([^)]*)\)", document.read_text()):
            file = document.parent / target if target else document
            assert file.exists(), f"{document.name}: {target}"
            assert not anchor or anchor in anchors(file), f"{document.name}: {target}#{anchor}"
    assert (ROOT / "docs" / "scan.png").stat().st_size < 500_000
    assert (ROOT / "docs" / "face.gif").stat().st_size < 2_000_000


def test_every_command_it_shows_exists():
    from eschorty_ros.cli import COMMANDS

    shown = set(re.findall(r"^    eschorty (\w+)", README, re.MULTILINE))
    assert shown
    assert shown <= set(COMMANDS)


def test_paths_in_the_documents_exist():
    for document in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")):
        for path in re.findall(
            r"`((?:eschorty_ros|test|docs|config)/[\w/]+(?:\.\w+|/))`", document.read_text()
        ):
            assert (ROOT / path).exists(), f"{document.name} names {path}"


def test_the_architecture_names_files_and_functions_that_exist():
    """A list item's functions stand in a file of that item or, without one, of those before."""
    page = (ROOT / "docs" / "architecture.md").read_text()
    sources = ""
    for item in re.findall(r"^(?:\d+\.|- ) .*", page, re.MULTILINE):
        names = re.findall(r"`([\w./]+)`", item)
        files = [ROOT / "eschorty_ros" / name for name in names if name.endswith(".py")]
        for file in files:
            assert file.is_file(), file
        sources = "\n".join(file.read_text() for file in files) or sources
        for name in names:
            if re.fullmatch(r"(?!_)[A-Z]\w+(\.\w+)?|[a-z]\w+_\w+", name.strip()):
                for part in name.split("."):
                    assert re.search(rf"\b{part}\b", sources), f"{name} is not in {files}"
    for folder in re.findall(r"^\| `(\w+)/`", page, re.MULTILINE):
        assert (ROOT / "eschorty_ros" / folder).is_dir()
