"""README and docs: commands and examples run, links, paths and names exist."""

import contextlib
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import click
import numpy as np
import pytest
from click.testing import CliRunner
from grid_clouds import cloud, moved

from eschorty_ros.cli import COMMANDS, main
from eschorty_ros.core.line import CENTROIDS
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.core.storage import write_cloud
from eschorty_ros.simulation.pixels import PRESETS
from eschorty_ros.simulation.scenes import NAMES
from eschorty_ros.surfaces.register import pose_matrix

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
PAGES = (README, *sorted((ROOT / "docs").glob("*.md")))
# One after the other in one folder: a page may use what one before it has made.
RUN = [
    README if name == "README" else ROOT / "docs" / f"{name}.md"
    for name in ("README", "tutorial", "gallery", "clouds", "recordings", "calibration", "design",
                 "development")
]  # fmt: skip
# Only their options are checked here; the tests named run them.
ELSEWHERE = (
    "eschorty scan",  # the nodes: test/cli/test_scan_command.py
    "eschorty report",  # minutes: test/report/test_report_command.py, test/experiments
    "--browser", "--live", "--window",  # until Ctrl-C: test/nodes/viewer, test/viewer
    "--fake",  # the nodes: test/cli/test_calibrate_fake_command.py
    "--moving",  # two long sweeps: test/cli/test_calibrate_command.py
    "--dask",  # a cluster: test/cli/test_cli.py
)  # fmt: skip
# They change the computer or are other programs' own, so that no test runs them.
NOT_RUN = {
    "sudo", "export", "for", "do", "done", "colcon", "source", ".", "python3", "cmp",
    "EVENTS=qos_overrides./eschorty/camera/events",
}  # fmt: skip
SHORT = {"simulate": {"stop_mm": 18.0}}
# The end of two long sweeps, which only --moving reads.
NEARER = {"810": "60"}


def code(page, inline=("eschorty", "ros2", "make")):
    """Lines of the indented blocks, continued ones joined, then commands within sentences."""
    text = page.read_text()
    fences = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)
    plain = fences.sub("", text).replace("\\\n", " ")
    lines = re.findall(r"(?:^\n|\A)((?:^    \S.*\n(?:^      .*\n)*)+)", plain, re.MULTILINE)
    for block in lines:
        yield from (line.strip() for line in re.sub(r"\n {5,}", " ", block).splitlines())
    for text in re.findall(r"`([^`]+)`", plain):
        if text.split()[0] in inline and len(text.split()) > 1 and "..." not in text:
            yield " ".join(text.split())


def commands(page):
    """Commands of a page in order, without comments, those joined by && apart."""
    for line in code(page):
        for part in re.split(r"\s&&\s|;\s", re.sub(r"(^|\s)#\s.*", "", line)):
            if part:
                yield part.strip()


def blocks(kind):
    """Lines of the indented blocks of the pages that run, each once."""
    found = (re.sub(r"\s#\s.*", "", line).strip() for page in RUN for line in code(page, ()))
    return list(dict.fromkeys(line for line in found if line.startswith(f"{kind} ")))


def shown(kind):
    """Commands of all pages that begin with a word."""
    found = {text for page in PAGES for text in commands(page) if text.split()[0] == kind}
    assert found, kind
    return sorted(found)


def check_options(words):
    """Parse the line of a command; the files that it reads are made."""
    with main.make_context("eschorty", words[:1]) as outer:
        command = main.get_command(outer, words[0])
        for _ in range(9):
            try:
                return command.make_context(words[0], words[1:], outer)
            except (click.MissingParameter, click.BadOptionUsage):
                return None  # a sentence that names a command and its option
            except click.BadParameter as error:
                missing = re.search(r"'([^']+)' does not exist", str(error))
                if missing is None:
                    raise
                Path(missing[1]).parent.mkdir(parents=True, exist_ok=True)
                Path(missing[1]).touch()
    raise AssertionError(words)


def test_every_command_has_these_options():
    for text in shown("eschorty"):
        words = ["1" if word == "N" else word for word in shlex.split(text)[1:]]
        if words[0].startswith("-"):
            continue
        assert words[0] in COMMANDS, text
        if len(words) > 1 and "--help" not in words:
            with TemporaryDirectory() as made, contextlib.chdir(made):
                check_options(words)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where the pages' commands run, with what a reader brings along."""
    made = tmp_path_factory.mktemp("pages")
    (made / "config").symlink_to(ROOT / "config")
    first = cloud(relief)
    write_cloud(made / "front.pcd", first)
    write_cloud(made / "side.pcd", moved(first, pose_matrix([0.0, 30.0, 0.0, 0.0, 0.0, 15.0])))
    model = load_calibration("config_3_as_built").model()
    range_mm = np.linspace(820.0, 2050.0, 9)
    rows = model.row(range_mm, np.full(9, 640))
    lines = [f"{row:.3f},{at:.1f}\n" for row, at in zip(rows, range_mm, strict=True)]
    (made / "targets.csv").write_text("row,range_mm\n" + "".join(lines))
    return made


def relief(y, z):
    return 1300.0 + 6.0 * np.sin(y / 5.0 + 0.3 * np.sin(z / 9.0)) * np.cos(z / 7.0)


@pytest.fixture(scope="module")
def made(folder, open3d):
    """The folder after the commands of the pages, in their order."""
    ran = 0
    with contextlib.chdir(folder):
        for text in blocks("eschorty"):
            if any(part in text for part in ELSEWHERE):
                continue
            words = [NEARER.get(word, word) for word in shlex.split(text)[1:]]
            done = CliRunner().invoke(main, words, default_map=SHORT)
            assert done.exit_code == 0, f"{text}\n{done.output}{done.exception!r}"
            ran += 1
    assert ran > 20
    return folder


def test_the_commands_run_in_the_order_of_the_pages(made):
    for name in (
        "rec/cloud.png",
        "planes.png",
        "part.png",
        "both.png",
        "my.png",
        "built.html",
    ):
        assert (made / name).stat().st_size > 10_000, name


def test_the_python_examples_run(made):
    (made / "mine").mkdir()
    shutil.copy(made / "rec" / "events.raw", made / "mine")
    pages = [README, *(ROOT / "docs" / f"{name}.md" for name in ("python", "calibration"))]
    found = re.findall(r"```python\n(.*?)```", "\n".join(map(Path.read_text, pages)), re.DOTALL)
    done = subprocess.run(
        [sys.executable, "-c", "".join(found)],
        cwd=made, capture_output=True, text=True, timeout=300,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.count(" points") == 6
    for name in ("rec/cloud.ply", "mine/cloud.ply"):
        assert (made / name).stat().st_size > 10_000


def test_make_targets_and_extras_exist():
    makefile = (ROOT / "Makefile").read_text()
    for text in shown("make"):
        assert re.search(rf"^{text.split()[1]}:", makefile, re.MULTILINE), text
    extras = (ROOT / "setup.py").read_text()
    for text in shown("pip"):
        for extra in re.findall(r"\.\[(\w+)\]", text):
            assert f'"{extra}": [' in extras, text


def test_the_names_in_ros2_commands_exist():
    interfaces = (ROOT / "docs" / "interfaces.md").read_text()
    arguments = (ROOT / "eschorty_ros/nodes/one_process/launch_arguments.py").read_text()
    executables = (ROOT / "CMakeLists.txt").read_text()
    for text in shown("ros2"):
        for name in re.findall(r"\s/eschorty/([\w/]+)", text):
            known = f"`{name}`" in interfaces or f"## {name}" in interfaces
            assert known or name in re.findall(r"\w+", executables), text
        for kind, name in re.findall(r"\beschorty_ros/(action|msg|srv)/(\w+)", text):
            assert (ROOT / kind / f"{name}.{kind}").is_file(), text
        for name in re.findall(r"-p (\w+):=", text):
            assert f"`{name}`" in interfaces, text
        if found := re.match(r"ros2 run eschorty_ros (\w+)", text):
            assert re.search(rf"\b{found[1]}\b", executables), text
        if found := re.match(r"ros2 launch eschorty_ros (\S+)(.*)", text):
            assert (ROOT / "launch" / found[1]).is_file(), text
            for name in re.findall(r"(\w+):=", found[2]):
                assert f'"{name}"' in arguments, text


def test_every_other_command_is_known_not_to_run():
    first = {text.split()[0] for page in PAGES for text in commands(page)}
    assert first == NOT_RUN | {"eschorty", "make", "pip", "ros2"}


def anchors(page):
    """Names that headings of a page are linked by."""
    titles = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def test_links_and_the_picture_exist():
    for document in PAGES:
        for target, anchor in re.findall(r"\]\(([^)#]*)#?([^)]*)\)", document.read_text()):
            file = document.parent / target if target else document
            assert file.exists(), f"{document.name}: {target}"
            assert not anchor or anchor in anchors(file), f"{document.name}: {target}#{anchor}"
    assert (ROOT / "docs" / "scan.png").stat().st_size < 500_000
    assert (ROOT / "docs" / "face.gif").stat().st_size < 2_000_000


def test_paths_in_the_documents_exist():
    for document in PAGES:
        for path in re.findall(
            r"`((?:eschorty_ros|test|docs|config)/[\w/]+(?:\.\w+|/))`", document.read_text()
        ):
            assert (ROOT / path).exists(), f"{document.name} names {path}"


@pytest.mark.parametrize(
    ("page", "names"), [("tutorial", NAMES), ("glossary", CENTROIDS), ("ros", PRESETS)]
)
def test_lists_are_complete(page, names):
    text = (ROOT / "docs" / f"{page}.md").read_text()
    missing = [name for name in names if f"`{name}`" not in text]
    assert not missing, f"docs/{page}.md does not name {', '.join(missing)}"


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


def test_the_readme_has_the_speeds_that_the_benchmark_wrote():
    page = (ROOT / "docs" / "performance.md").read_text()
    row = r"^\| \d+ Hz \| [\d.]+ M \| [\d.]+ \| \d+ \| (\d+) \| [\d.]+ \| [\d.]+ \| (\d+) \|$"
    speeds, ratios = zip(*re.findall(row, page, re.MULTILINE), strict=True)
    (slow, fast), (low, high) = sorted(map(int, speeds)), sorted(map(int, ratios))
    assert f"{slow} to {fast} million events a second, {low} to {high} times" in README.read_text()
