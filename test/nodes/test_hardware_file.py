"""The file of `eschorty scan --hardware`: real drivers, and no misspelt parameter."""

import ast
import re
from pathlib import Path

import pytest
import yaml

pytest.importorskip("rclpy", reason="rclpy is not installed")

from eschorty_ros.core.errors import FormatError
from eschorty_ros.nodes.composition import NODES
from eschorty_ros.nodes.hardware_file import read_hardware

GUIDE = Path(__file__).parents[2] / "docs" / "hardware.md"


def examples(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", GUIDE.read_text(), re.DOTALL)


def written(folder: Path, text: str) -> Path:
    path = folder / "bench.yaml"
    path.write_text(text)
    return path


def test_real_drivers_unless_told(tmp_path):
    tables = read_hardware(
        written(tmp_path, "laser: {driver: fake}\nstage: {port: /dev/ttyUSB0}\n")
    )
    assert {name: table["driver"] for name, table in tables.items()} == {
        "camera": "evk4",
        "laser": "fake",
        "stage": "apt",
    }
    assert tables["stage"]["port"] == "/dev/ttyUSB0"
    assert set(read_hardware(written(tmp_path, ""))) == {"camera", "laser", "stage"}


def test_the_guides_example_is_accepted(tmp_path):
    tables = read_hardware(written(tmp_path, examples("yaml")[-1]))
    assert tables["camera"]["serial"] == "00051234"
    assert tables["reconstruction"] == {"trigger_source": "stage"}


def test_the_guides_parameters_and_launch_file_are_what_the_nodes_have(tmp_path):
    given = yaml.safe_load(examples("yaml")[0])
    values = {
        name.removeprefix("/eschorty/"): table["ros__parameters"] for name, table in given.items()
    }
    assert read_hardware(written(tmp_path, yaml.safe_dump(values))) == values
    launch = ast.parse(examples("python")[0])
    nodes = next(part.value for part in launch.body if isinstance(part, ast.Assign))
    assert ast.literal_eval(nodes) == tuple(NODES)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("camra: {}", ("'camra' is no node", "did you mean camera?")),
        ("laser: {hihg_v: 5.0}", ("'hihg_v' is no parameter of laser", "did you mean high_v?")),
        ("laser: 5", ("laser is 5", "write parameters under it")),
        ("[1]", ("it holds [1]",)),
        ("laser: {", ("correct the YAML",)),
    ],
)
def test_what_cannot_be_meant_is_one_line(tmp_path, text, words):
    with pytest.raises(FormatError) as refused:
        read_hardware(written(tmp_path, text))
    assert "\n" not in str(refused.value)
    for word in (*words, "bench.yaml"):
        assert word in str(refused.value)
