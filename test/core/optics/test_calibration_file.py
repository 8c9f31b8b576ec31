"""Calibration files: the four builds, round trips, and faults named in one line."""

import re
import shutil
import subprocess
import sys
from dataclasses import FrozenInstanceError, replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from eschorty_ros.core.base import files
from eschorty_ros.core.base.errors import ArgumentError, CalibrationError
from eschorty_ros.core.optics import (
    BUILDS,
    Calibration,
    load_calibration,
    refuse_other_instrument,
    save_calibration,
)

ROOT = Path(__file__).resolve().parents[3]
PRINTED = {
    "nominal": (-7.77, -36510.29, -1084.00),
    "config_1": (-8.76, -32409.56, -1086.04),
    "config_2": (-7.58, -37413.82, -1075.30),
    "config_3": (-7.62, -37261.86, -1142.74),
}
FIT: dict[str, Any] = {
    "id": "c3-2025-11-02", "date": "2025-11-02", "parameters_fitted": ("k_prime_px", "b_prime_px"),
    "covariance": ((400.0, 1.5), (1.5, 0.09)), "residual_rms_px": 0.31, "condition_number": 8.2,
    "range_mm": (820.0, 2050.0),
}  # fmt: skip


def keys() -> dict[str, Any]:
    return yaml.safe_load((ROOT / "config" / "config_3.yaml").read_text())


def fitted() -> Calibration:
    return Calibration(**{**keys(), **FIT, "k_mm": 24.1, "roi_px": (10, 9, 120, 40)})


@pytest.mark.parametrize("build", BUILDS)
def test_shipped_builds_carry_the_printed_numbers(build):
    c = load_calibration(build)
    assert (c.theta_prime_deg, c.k_prime_px, c.b_prime_px) == PRINTED[build]
    assert (c.name, c.focal_length_mm, c.f_number, c.theta_deg) == (build, 24.0, 2.0, 85.87)
    assert (c.pixel_um, c.columns, c.rows, c.principal_column) == (4.86, 1280, 720, 639.5)
    assert replace(c, principal_column=None, columns=640).model().principal_column == 319.5
    assert (c.b_mm, c.k_mm, c.stage_direction) == (0.0, None, (0.0, 1.0, 0.0))
    assert c.object_scale_mm == pytest.approx(24.0624852154, abs=1e-10)
    m = c.model()
    assert (m.k_mm, m.k_prime_px, m.b_mm, m.b_prime_px) == (
        c.object_scale_mm, c.k_prime_px, c.b_mm, c.b_prime_px,
    )  # fmt: skip


def test_a_given_k_is_taken_as_it_is():
    assert fitted().object_scale_mm == fitted().model().k_mm == 24.1


@pytest.mark.parametrize("make", [lambda: load_calibration("config_3"), fitted])
def test_saving_and_loading_gives_the_same(tmp_path, make):
    file = tmp_path / "calibration.yaml"
    save_calibration(make(), file)
    assert load_calibration(file) == make()
    assert load_calibration(str(file)).model() == make().model()
    assert ("k_mm" in file.read_text()) == (make().k_mm is not None)
    assert [entry.name for entry in tmp_path.iterdir()] == [file.name]


def test_what_is_no_calibration_is_not_saved(tmp_path):
    with pytest.raises(ArgumentError, match=r"calibration is 'config_3'; give a Calibration"):
        save_calibration("config_3", tmp_path / "c.yaml")
    assert not (tmp_path / "c.yaml").exists()


def test_numbers_survive_to_the_last_bit(tmp_path):
    odd = replace(
        fitted(), k_prime_px=-37261.86 * (1 + 2**-52), b_mm=1e-7 / 3, residual_rms_px=1e22
    )
    save_calibration(odd, tmp_path / "c.yaml")
    assert load_calibration(tmp_path / "c.yaml") == odd


def test_a_failed_save_leaves_the_old_file(tmp_path, monkeypatch):
    file = tmp_path / "c.yaml"
    save_calibration(load_calibration("config_1"), file)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(ArgumentError, match="No space left"):
        save_calibration(load_calibration("config_2"), file)
    assert load_calibration(file).name == "config_1"
    assert [entry.name for entry in tmp_path.iterdir()] == [file.name]


def test_whole_numbers_and_dates_are_read_as_meant(tmp_path):
    text = yaml.safe_dump({**keys(), "focal_length_mm": 24, "b_mm": 0}) + "date: 2025-11-02\n"
    (tmp_path / "c.yaml").write_text(text)
    c = load_calibration(tmp_path / "c.yaml")
    assert (c.focal_length_mm, c.b_mm, c.date) == (24.0, 0.0, "2025-11-02")


def test_a_calibration_cannot_be_changed_in_place():
    with pytest.raises(FrozenInstanceError):
        load_calibration("nominal").b_mm = 1.0


WITHOUT = object()


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        ({"k_prime_px": WITHOUT}, ["k_prime_px is missing", "add it"]),
        ({"k_prime_px": WITHOUT, "k_prim_px": -1.0}, ["k_prim_px", "did you mean k_prime_px?"]),
        ({"focal_length": 24.0}, ["focal_length is 24.0", "did you mean focal_length_mm?"]),
        ({"comment": "hello"}, ["comment is 'hello'", "remove it"]),
        ({"k_prime_px": 37261.86}, ["k_prime_px is 37261.86", "below 0"]),
        ({"k_prime_px": -4900.0}, ["k_prime_px is -4900", "a 24 mm lens needs less than -4938"]),
        ({"b_mm": 800.0}, ["b_prime_px is -1142.74", "would see -15 to 1316 mm"]),
        ({"b_prime_1_px": 4e3}, ["b_prime_1_px is 4000", "choose smaller terms"]),
        ({"b_prime_px": 0.5}, ["b_prime_px is 0.5", "to -1"]),
        ({"b_mm": float("nan")}, ["b_mm is nan", "finite"]),
        ({"b_mm": "1.5 mm"}, ["b_mm is '1.5 mm'", "write a number"]),
        ({"f_number": True}, ["f_number is True"]),
        ({"f_number": [2.0]}, ["f_number is [2.0]"]),
        ({"theta_deg": 0.0}, ["theta_deg is 0.0", "above 0"]),
        ({"theta_prime_deg": 0.0}, ["theta_prime_deg is 0.0", "-7.62"]),
        ({"k_mm": -24.0}, ["k_mm is -24.0", "above 0"]),
        ({"columns": 1280.5}, ["columns is 1280.5"]),
        ({"rows": 0}, ["rows is 0"]),
        ({"stage_direction": [0.0, 2.0, 0.0]}, ["stage_direction", "length is 2", "divide"]),
        ({"stage_direction": [0.0, 1.0]}, ["stage_direction is [0.0, 1.0]", "write 3"]),
        ({"stage_direction": ["a", 1.0, 0.0]}, ["stage_direction.0 is 'a'"]),
        ({"name": ""}, ["name is ''"]),
        ({"range_mm": [2000.0, 800.0]}, ["range_mm", "nearest range first"]),
        ({"condition_number": 0.5}, ["condition_number is 0.5"]),
        ({"residual_rms_px": -0.5}, ["residual_rms_px is -0.5"]),
        ({"parameters_fitted": ["b_mm", "b_mm"]}, ["parameters_fitted", "once"]),
        ({"covariance": [[1.0]]}, ["covariance", "0 parameters_fitted"]),
        (
            {"parameters_fitted": ["b_mm"], "covariance": [[1.0, 2.0]]},
            ["covariance", "1 parameters_fitted"],
        ),
        (
            {"parameters_fitted": ["b_mm", "k_mm"], "covariance": [[1.0, 0.5], [0.4, 1.0]]},
            ["covariance", "symmetric"],
        ),
        ({"parameters_fitted": ["b_mm"], "covariance": [[-1.0]]}, ["covariance", "positive"]),
        ({"parameters_fitted": ["zoom"]}, ["parameters_fitted", "'zoom'", "k_prime_px"]),
    ],
)
def test_faults_name_file_key_value_and_remedy(tmp_path, change, parts):
    data = {key: value for key, value in {**keys(), **change}.items() if value is not WITHOUT}
    file = tmp_path / "broken.yaml"
    file.write_text(yaml.safe_dump(data))
    with pytest.raises(CalibrationError) as caught:
        load_calibration(file)
    message = str(caught.value)
    assert re.match(rf"{file}( line \d+)?: ", message)
    assert "\n" not in message
    for part in parts:
        assert part in message


@pytest.mark.parametrize(
    ("content", "part"),
    [
        (b"", "has None instead of keys"),
        (b"- 1\n- 2\n", r"has \[1, 2\] instead of keys"),
        (b"name: [1\n", "line 2"),
        (b"name: a\nname: b\n", "line 2: key 'name' appears twice"),
        (b"name: !!python/object:os.system {}\n", "line 1: tags"),
        (b"\xff\xfe\x00", "not text"),
        (b"name: \x00\n", "correct the YAML"),
        (b"? [a, b]\n: 1\n", "line 1: a key is a list"),
        (b"frequency_hz: 70\nduty: 0.5\n", "'frequency_hz, duty' and is no calibration; .* name,"),
        (b"name: a\nusb: 1\nchannels: 2\n", "'usb, channels' and is no calibration"),
    ],
)
def test_a_file_that_is_no_calibration_is_named(tmp_path, content, part):
    file = tmp_path / "broken.yaml"
    file.write_bytes(content)
    with pytest.raises(CalibrationError, match=part) as caught:
        load_calibration(file)
    assert "\n" not in str(caught.value)
    assert "broken.yaml" in str(caught.value)


def test_unknown_names_and_paths_are_named(tmp_path):
    (tmp_path / "c.yaml").write_text("config_9\n")
    for name, words in (
        ("config_9", r"'config_9'.*nominal, config_1"),
        (tmp_path / "c.yaml", "'config_9'"),
        (tmp_path / "absent.yaml", r"cannot read .*absent\.yaml"),
        (tmp_path, "cannot read"),
        ("", r"''.*nominal, config_1"),
    ):
        with pytest.raises(CalibrationError, match=words):
            load_calibration(name)


@pytest.mark.parametrize(
    ("site", "config"),
    [
        ("lib/python3.11/site-packages", "share/eschorty_ros/config"),
        ("local/lib/python3.11/dist-packages", "share/eschorty_ros/config"),
        ("site-packages", "site-packages/eschorty_ros/config"),
        ("tree", "tree/config"),
    ],
)
def test_names_are_found_where_colcon_pip_and_git_put_them(tmp_path, monkeypatch, site, config):
    installed = tmp_path / site / "eschorty_ros" / "core" / "base" / "files.py"
    (tmp_path / config).mkdir(parents=True)
    shutil.copy(ROOT / "config" / "config_2.yaml", tmp_path / config / "shop_floor.yaml")
    monkeypatch.setattr(files, "__file__", str(installed))
    assert load_calibration("shop_floor").name == "config_2"


def test_reading_a_calibration_needs_no_ros_and_no_compiler():
    code = (
        "import sys, eschorty_ros.core.storage, eschorty_ros.core.optics as r;"
        "r.load_calibration('nominal');"
        "heavy = {'rclpy', 'numba', 'open3d', 'matplotlib', 'scipy'};"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"name": "config_1"}, r"name \(build\) is 'config_1' and the instrument's 'config_3'"),
        ({"columns": 640}, "columns .* 640 .* 1280"),
        ({"rows": 480}, "rows .* 480 .* 720"),
        ({"pixel_um": 15.0}, "pixel_um .* 15.0 .* 4.86"),
        ({"roi_px": (0, 100, 1280, 400)}, r"roi_px .* \(0, 100, 1280, 400\) .* None"),
    ],
)
def test_a_calibration_of_another_instrument_is_refused_by_name(change, words):
    active = load_calibration("config_3")
    refuse_other_instrument(load_calibration("config_3_as_built"), active)
    with pytest.raises(CalibrationError, match=words):
        refuse_other_instrument(replace(active, **change), active)


@pytest.mark.parametrize("window", [(0, 0, 1281, 720), (-1, 0, 10, 10), (0, 700, 10, 30),
                                    (0, 0, 0, 10)])  # fmt: skip
def test_a_window_off_the_sensor_is_refused(window):
    with pytest.raises(ValueError, match="roi_px"):
        replace(load_calibration("config_3"), roi_px=window)
