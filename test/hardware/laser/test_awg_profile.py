"""Profiles of generators: read from YAML, refused in one line when they are wrong."""

from pathlib import Path

import pytest

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.hardware.laser.awg_profile import BURST_SETTINGS, SETTINGS, Setting, load_profile

PROFILE = Path(__file__).parents[3] / "config" / "awg_utg900e.yaml"


def test_profile_is_found_by_name_and_by_path() -> None:
    assert load_profile("utg900e") == load_profile(PROFILE)
    assert set(load_profile("utg900e").settings) == {*SETTINGS, *BURST_SETTINGS}


@pytest.mark.parametrize(
    ("before", "after", "text"),
    [
        ("channels: 2", "chanels: 2", "chanels is 2, and no such key exists; did you mean"),
        ("kind: keyword", "kind: letters", "settings.amplitude_unit.kind is 'letters'"),
        ("channels: 2", "channels: two", "channels is 'two'"),
        ("BASE:DUTY", "BASE:{duty}", "only {channel} can be filled in"),
        ("  duty:\n", "  share:\n", "; add duty"),
        ("  burst_type:\n", "  burst_kind:\n", "; add burst_type"),
        ("burst: {mode", "# burst: {mode", ", which nothing uses"),
        (
            "dark_limit_v: 0.1",
            "dark_limit_v: 0.001",
            "dark_limit_v is 0.001; raise it to dark_high_v",
        ),
        ("(?i)utg", "(?i)utg(", "it is no regular expression"),
        ("0x0834", "0x10834", "usb.product_ids.0 is 67636"),
    ],
)
def test_wrong_profiles_are_one_line(tmp_path: Path, before: str, after: str, text: str) -> None:
    path = tmp_path / "wrong.yaml"
    original = PROFILE.read_text()
    assert before in original
    path.write_text(original.replace(before, after))
    with pytest.raises(ArgumentError) as caught:
        load_profile(path)
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)


def test_unknown_name_lists_those_there_are() -> None:
    with pytest.raises(ArgumentError, match=r"choose one of .*utg900e.* or give a path"):
        load_profile("sdg2000")


@pytest.mark.parametrize(
    ("spelt", "found", "same"),
    [
        ("SQUare", "SQU", True),
        ("SQUare", "square", True),
        ("SQUare", "SQUARE", True),
        ("SQUare", "SQUA", False),
        ("SINe", "SIN", True),
        ("PULSe", "SINE", False),
    ],
)
def test_replies_in_long_and_short_form(spelt: str, found: str, same: bool) -> None:
    assert Setting(command="MODe", kind="keyword").agrees(spelt, found) is same


def test_tolerance_is_for_digits_not_for_clamps() -> None:
    frequency = load_profile("utg900e").settings["frequency"]
    assert frequency.agrees(12345.678, 12345.7)
    assert not frequency.agrees(20_000.0, 19_999.0)
