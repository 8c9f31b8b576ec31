"""The file of `eschorty scan --hardware`: real drivers, and no misspelt parameter."""

import contextlib
import re
from pathlib import Path

import pytest
import yaml
from mutation import mutations

from eschorty_ros.core.base.errors import FormatError
from eschorty_ros.nodes.one_process.hardware_file import TABLES, read_hardware

ROOT = Path(__file__).parents[3]
GUIDE, CONFIG = ROOT / "docs" / "hardware.md", ROOT / "config"


def ros_file(**tables: dict[str, object]) -> str:
    named = {f"/eschorty/{name}": {"ros__parameters": table} for name, table in tables.items()}
    return yaml.safe_dump(named)


def written(folder: Path, text: str) -> Path:
    path = folder / "lab.yaml"
    path.write_text(text)
    return path


def test_drivers_are_real_by_default(tmp_path):
    text = ros_file(laser={"driver": "fake"}, stage={"port": "/dev/ttyUSB0"})
    tables = read_hardware(written(tmp_path, text))
    assert {name: table["driver"] for name, table in tables.items()} == {
        "camera": "evk4",
        "laser": "fake",
        "stage": "apt",
    }
    assert tables["stage"]["port"] == "/dev/ttyUSB0"
    assert set(read_hardware(written(tmp_path, ""))) == {"camera", "laser", "stage"}


def test_the_guides_file_is_accepted_and_says_what_it_shows(tmp_path):
    (text,) = re.findall(r"```yaml\n(.*?)```", GUIDE.read_text(), re.DOTALL)
    tables = read_hardware(written(tmp_path, text))
    given = {f"/eschorty/{name}": {"ros__parameters": table} for name, table in tables.items()}
    assert given == yaml.safe_load(text)


def test_the_file_to_copy_holds_the_defaults():
    given = yaml.safe_load((CONFIG / "parameters.yaml").read_text())
    assert read_hardware(CONFIG / "parameters.yaml")
    for name, table in given.items():
        defaults = {param.name: param.default for param in TABLES[name.removeprefix("/eschorty/")]}
        values = table["ros__parameters"]
        assert values == {parameter: defaults[parameter] for parameter in values}
        assert all(type(values[key]) is type(defaults[key]) for key in values)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("camera: {}", ("'camera' is no node", "did you mean /eschorty/camera?")),
        (
            ros_file(laser={"hihg_v": 5.0}),
            ("'hihg_v' is no parameter of /eschorty/laser", "did you mean high_v?"),
        ),
        (
            ros_file(stage={"driver": "atp"}),
            ("/eschorty/stage: driver is 'atp'; choose one of fake, apt",),
        ),
        ("/eschorty/laser: 5", ("/eschorty/laser is 5", "write parameters under ros__parameters")),
        ("/eschorty/laser: {high_v: 5.0}", ("write parameters under ros__parameters",)),
        ("[1]", ("it holds [1]",)),
        ("/eschorty/laser: {", ("correct the YAML",)),
    ],
)
def test_what_cannot_be_meant_is_one_line(tmp_path, text, words):
    with pytest.raises(FormatError) as refused:
        read_hardware(written(tmp_path, text))
    assert "\n" not in str(refused.value)
    for word in (*words, "lab.yaml"):
        assert word in str(refused.value)


def test_a_mutated_parameter_file_ends_in_a_result_or_in_one_line(tmp_path):
    seed = 20261122
    refused = 0
    for number, mutant in enumerate(
        mutations((CONFIG / "parameters.yaml").read_bytes(), 150, seed)
    ):
        print(f"seed {seed}, mutant {number}")
        file = tmp_path / "mutant.yaml"
        file.write_bytes(mutant)
        with contextlib.suppress(FormatError):
            read_hardware(file)
            continue
        refused += 1
    print(f"{refused} of 150 refused")
    assert refused


@pytest.mark.parametrize(
    "text",
    ["/eschorty/laser: {ros__parameters: {high_v: " + "9" * 5000 + "}}\n",
     "/eschorty/laser: {ros__parameters: " + "[" * 3000, "a: &a [*a]\n",
     "/eschorty/laser: {ros__parameters: {high_v: [[1], {a: 1}]}}\n",
     "/eschorty/" + "x" * 5000 + ": 1\n", "? [1]\n: 2\n"],
    ids=["digits", "deep", "alias", "nested", "long", "key"],
)  # fmt: skip
def test_what_could_hurt_names_file_and_line(tmp_path, text):
    with pytest.raises(FormatError, match=r"\.yaml line 1") as caught:
        read_hardware(written(tmp_path, text))
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) <= 300
