"""The launch files' arguments: every bad one is refused before anything starts, and named."""

import re
from pathlib import Path

import pytest

from eschorty_ros.core.base.errors import EschortyError
from eschorty_ros.nodes.one_process import launch_arguments
from eschorty_ros.nodes.one_process.launch_arguments import CALIBRATE, REPLAY, SCAN

FILES = {
    "scan": (SCAN, "fake camera parameters trigger scene pixels effects calibration frequency"
             " speed start stop rviz auto_scan"),
    "calibrate": (CALIBRATE, "fake camera parameters trigger scene pixels effects calibration"
                  " as_built frequency distances method capture_time calibration_folder"
                  " auto_calibrate"),
    "replay": (REPLAY, "recording rate parameters rviz"),
}  # fmt: skip
BAD = """scan speed fast 0 0.5 nan 1e400; scan frequency abc 5; scan scene foo
    scan calibration /nope
    scan start -1; scan stop 0.01 9; scan pixels bad; scan effects foo=1; scan trigger camera
    scan fake maybe; scan camera no; scan auto_scan 1; scan rviz yes true
    scan parameters /nope.yaml
    calibrate as_built /nope; calibrate distances /nope.csv; calibrate method guess
    calibrate capture_time 0; replay recording /nope; replay rate -1"""
ROWS = (row.split() for row in BAD.replace("\n", ";").split(";"))
CASES = [(file, name, value) for file, name, *values in ROWS for value in values]


class Given(dict[str, str]):
    """The default texts of a launch file, and the names of those that were read."""

    def __init__(self, file: str, **others: str) -> None:
        super().__init__({each.name: each.default or "" for each in FILES[file][0]} | others)
        self.read: set[str] = set()

    def __getitem__(self, name: str) -> str:
        self.read.add(name)
        return super().__getitem__(name)


def written(folder: Path, text: str) -> str:
    path = folder / "parameters.yaml"
    path.write_text(text)
    return str(path)


@pytest.mark.parametrize(("file", "name", "value"), CASES)
def test_a_bad_argument_is_one_line_with_its_name(
    file: str, name: str, value: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def without_rviz(package: str) -> str:
        raise launch_arguments.PackageNotFoundError(package)

    monkeypatch.setattr(launch_arguments, "get_package_prefix", without_rviz)
    with pytest.raises(EschortyError) as refused:
        getattr(launch_arguments, file)(Given(file, **{name: value}))
    line = str(refused.value)
    assert name in line
    assert "\n" not in line
    assert len(line) <= 300


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("/eschorty/laser: {ros__parameters: {high_mx_v: 3.3}}", "'high_mx_v' did you mean high_m"),
        ("/eschorty/laser: {ros__parameters: {frequency: fast}}", "/eschorty/laser: frequency fas"),
        ("/eschorty/stage: {ros__parameters: {controller: foo}}", "controller 'foo' kbd101"),
        ("/eschorty/camera: {ros__parameters: {roi: 5}}", "roi is 5"),
        ("/eschorty/camera: {", "correct the YAML"),
        ("/eschorty/scanner: {ros__parameters: {speed: 0.5}}", "speed 0.5 0.25"),
    ],
)
def test_a_bad_parameter_file_is_one_line(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(EschortyError) as refused:
        launch_arguments.scan(Given("scan", parameters=written(tmp_path, text)))
    assert "\n" not in str(refused.value)
    assert all(word in str(refused.value) for word in words.split())


@pytest.mark.parametrize("file", FILES)
def test_every_argument_is_described_and_read(file: str, tmp_path: Path) -> None:
    table, names = FILES[file]
    given = Given(file)
    if file == "replay":
        given["recording"] = str(tmp_path)
        with pytest.raises(EschortyError, match=str(tmp_path)):
            launch_arguments.replay(given)
        given.read |= {"rviz"}
    else:
        nodes = set(getattr(launch_arguments, file)(given).nodes)
        both = {"camera", "laser", "stage", "reconstruction"}
        assert nodes == (both | {"scanner"} if file == "scan" else both)
    assert {argument.name for argument in table} == given.read == set(names.split())
    assert all(len(argument.description) > 15 for argument in table)


def test_the_page_has_every_argument_with_its_default() -> None:
    lines = (Path(__file__).parents[3] / "docs" / "ros.md").read_text().splitlines()
    for argument in SCAN:
        line = next(line for line in lines if re.match(rf"\| .*`{argument.name}`", line))
        assert f"`{argument.default}`" in line or "`config/" in line


def test_another_driver_in_place_of_the_camera(tmp_path: Path) -> None:
    given = Given("scan", camera="false", fake="false", trigger="none", frequency="80",
                  parameters=written(tmp_path, ""))  # fmt: skip
    plan = launch_arguments.scan(given)
    assert "camera" not in plan.nodes
    assert plan.bench is None
    assert plan.nodes["laser"] == {"driver": "awg", "frequency": 80.0, "watch": "stage"}
    reliability = f"qos_overrides.{launch_arguments.EVENTS}.subscription.reliability"
    assert plan.nodes["reconstruction"][reliability] == "best_effort"


def test_the_bench_has_the_build_of_its_argument() -> None:
    plan = launch_arguments.calibrate(Given("calibrate"))
    assert plan.bench == {"scene": "posts", "pixels": "paper", "effects": "none",
                          "trigger": "stage", "calibration": "config_3_as_built"}  # fmt: skip
