"""Calibrations of a folder by bare name: whatever lies there, nothing else is read or written."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from eschorty_ros.core.base.errors import ArgumentError, CalibrationError
from eschorty_ros.core.optics import (
    load_calibration,
    load_named_calibration,
    save_calibration,
    save_named_calibration,
)

BUILD = load_calibration("config_3")
PATHS = [
    "../c", "/etc/shadow", "a/b", "a\\b", ".hidden", "..", "", "a\nb", "a\0b", "\udc80", "x" * 101,
    "x" * 100_000, 3, None,
]  # fmt: skip


def make_fifo(path: Path) -> None:
    os.mkfifo(path)


def link_to_zero(path: Path) -> None:
    path.symlink_to("/dev/zero")


def link_out_of_the_folder(path: Path) -> None:
    save_calibration(BUILD, path.parent.parent / "outside.yaml")
    path.symlink_to("../outside.yaml")


def make_folder(path: Path) -> None:
    path.mkdir()


NO_FILES = [make_fifo, link_to_zero, link_out_of_the_folder, make_folder]


def test_a_calibration_is_saved_and_loaded_by_bare_name(tmp_path: Path) -> None:
    folder = tmp_path / "made" / "here"
    assert save_named_calibration(folder, BUILD) == folder / "config_3.yaml"
    fitted = replace(BUILD, id="c3 2026")
    assert save_named_calibration(folder, fitted) == folder / "c3 2026.yaml"
    assert save_named_calibration(folder, fitted, "mine.yaml") == folder / "mine.yaml"
    assert load_named_calibration(folder, "mine") == load_named_calibration(folder, "c3 2026.yaml")
    assert load_named_calibration(folder, "nominal").name == "nominal"
    with pytest.raises(CalibrationError, match=r"no calibration named 'no such'.*save it there"):
        load_named_calibration(folder, "no such")


@pytest.mark.parametrize("name", PATHS)
def test_only_bare_names_are_taken(tmp_path: Path, name: Any) -> None:
    save_calibration(BUILD, tmp_path / "c.yaml")
    folder = tmp_path / "folder"
    with pytest.raises(CalibrationError, match="without slashes") as caught:
        load_named_calibration(folder, name)
    assert len(str(caught.value)) <= 300
    if name:
        with pytest.raises(CalibrationError, match="without slashes"):
            save_named_calibration(folder, BUILD, name)
        with pytest.raises(ValueError, match="id"):
            replace(BUILD, id=name)
    assert [entry.name for entry in tmp_path.iterdir()] == ["c.yaml"]


@pytest.mark.parametrize("put", NO_FILES)
def test_links_pipes_and_folders_are_refused_without_waiting(tmp_path: Path, put: Any) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    put(folder / "odd.yaml")
    before = os.lstat(folder / "odd.yaml")
    with pytest.raises(CalibrationError, match=r"cannot read .*odd\.yaml.* regular file"):
        load_named_calibration(folder, "odd")
    with pytest.raises(CalibrationError, match=r"cannot write .*odd\.yaml.* regular file"):
        save_named_calibration(folder, BUILD, "odd")
    assert os.lstat(folder / "odd.yaml") == before
    assert [entry.name for entry in folder.iterdir()] == ["odd.yaml"]


@pytest.mark.parametrize("path", ["/dev/zero", "/dev/stdin", "fifo.yaml", "large.yaml", "x" * 5000])
def test_a_path_given_at_the_start_is_read_in_bounded_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, path: str
) -> None:
    monkeypatch.chdir(tmp_path)
    os.mkfifo("fifo.yaml")
    Path("large.yaml").write_bytes(b"#" * 65_537)
    with pytest.raises(CalibrationError, match="cannot read") as caught:
        load_calibration(Path(path))
    assert len(str(caught.value)) <= 300


def test_nothing_but_a_regular_file_is_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "c.yaml")
    with pytest.raises(ArgumentError, match="no regular file"):
        save_calibration(BUILD, tmp_path / "c.yaml")
