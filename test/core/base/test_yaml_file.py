"""YAML from anywhere: what it may hold, and one line with file and line for the rest."""

import pytest

from eschorty_ros.core.base.errors import FormatError
from eschorty_ros.core.base.yaml_file import BYTES_MAX, DEPTH_MAX, parse_yaml, read_yaml

BOMB = "a: &a [x, x]\n" + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)


def test_plain_values_are_read_with_their_lines(tmp_path):
    file = tmp_path / "a.yaml"
    file.write_text(
        "# a comment\nwhole: 0x1F\nreal: 1.5e+3\ntext: '007'\ndate: 2026-01-02\non: yes\n"
        "none:\nlist:\n- 1\n- {deep: -.inf}\n"
    )
    document = read_yaml(file, FormatError)
    assert document.data == {
        "whole": 31, "real": 1500.0, "text": "007", "date": "2026-01-02", "on": True, "none": None,
        "list": [1, {"deep": -float("inf")}],
    }  # fmt: skip
    assert document.at(("real",)) == f"{file} line 3"
    assert document.at(("list", 1, "deep")) == f"{file} line 10"
    assert document.at(("list", 1, "absent")) == f"{file} line 10"
    assert document.at(("absent",)) == str(file)
    file.write_text("")
    assert read_yaml(file, FormatError).data is None


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        (BOMB, 1, "anchors and aliases"),
        ("a: 1\nb: *c\n", 2, "anchors and aliases"),
        ("[" * (DEPTH_MAX + 1), 1, "deep"),
        ("[" * 60_000, 1, "deep"),
        ("- " * 30_000, 1, "deep"),
        ("{a: " * 15_000, 1, "deep"),
        ("a: 1\nb: " + "9" * 5000, 2, "a number of 5000 characters"),
        ("a: 0x" + "f" * 5000, 1, "a number of 5002 characters"),
        ("a: 0b_\n", 1, "no number"),
        ("a: 1" + "0" * 70 + ".5\n", 1, "a number of 73 characters"),
        ("a: " + "1:" * 29 + "1", 1, None),
        ("a: 1\na: 2\n", 2, "appears twice"),
        ("a: !!python/object:os.system {}\n", 1, "tags"),
        ("a: !!int ''\n", 1, "tags"),
        ("a: !!timestamp x\n", 1, "tags"),
        ("a: !!binary x\n", 1, "tags"),
        ("a: 1\n---\nb: 2\n", 2, "second document"),
        ("? [a]\n: 1\n", 1, "a key is a list"),
        ("? {a: 1}\n: 1\n", 1, "a key is a list"),
        ("a: [1\nb: 2\n", 2, ""),
        ("a: 1\n\tb: 2\n", 2, ""),
        ("a: 1\nb: \x07\n", 2, "character"),
        ('a: "\\UFFFFFFFF"\n', 1, "escape"),
        ("%YAML " + "1" * 5000 + ".1\n---\na: 1\n", 1, ""),
        ("a: " + "x" * 5000 + ": y\n", 1, ""),
        ("<<: 1\na: *", 2, ""),
    ],
)
def test_what_could_hurt_is_refused_in_one_line(text, line, words):
    if words is None:
        assert isinstance(parse_yaml(text.encode(), "a.yaml", FormatError).data["a"], int)
        return
    with pytest.raises(FormatError) as caught:
        parse_yaml(text.encode(), "a.yaml", FormatError)
    message = str(caught.value)
    assert message.startswith(f"a.yaml line {line}: ")
    assert words in message
    assert "\n" not in message
    assert len(message) <= 300


def test_a_file_beyond_the_limit_is_not_parsed(tmp_path):
    (tmp_path / "a.yaml").write_bytes(b"#" * (BYTES_MAX + 1))
    with pytest.raises(FormatError, match="larger than 65536 bytes"):
        read_yaml(tmp_path / "a.yaml", FormatError)
