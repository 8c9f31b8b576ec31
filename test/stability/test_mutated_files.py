"""Mutated files end in a result or in one stated line, in every reader of the package."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from mutation import mutations

from eschorty_ros.core.base.errors import EschortyError
from eschorty_ros.core.calibration import read_distances, read_targets
from eschorty_ros.core.evt3 import Decoder, Encoder
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import load_calibration, save_calibration
from eschorty_ros.core.storage import (
    POINT_DTYPE,
    read_cloud,
    read_laser_yaml,
    write_cloud,
    write_laser_yaml,
    write_stage_csv,
)
from eschorty_ros.core.storage.raw_file import RawReader, RawWriter
from eschorty_ros.core.storage.recording import load_recording
from eschorty_ros.hardware.camera.biases import load_bias_file, save_bias_file
from eschorty_ros.hardware.laser.awg_profile import load_profile

CONFIG = Path(__file__).parents[2] / "config"
SEED = 20261122
MUTANTS = 150


def raw(path):
    with RawWriter(path, width=64, height=64) as writer:
        t = np.arange(300) * 40
        writer.write(Encoder(64, 64).encode(t, t % 64, t % 61, t % 2))


def decoded(path):
    reader = RawReader(path)
    decoder = Decoder(reader.header.width, reader.header.height)
    return [decoder.decode(chunk) for chunk in reader.chunks()]


def cloud(path):
    points = np.zeros(20, POINT_DTYPE)
    points["t"] = np.arange(20) * 0.01
    write_cloud(path, points)


def stage(path):
    write_stage_csv(path, [0, 10_000, 20_000], [10.0, 10.5, 11.0])


def recording(path):
    """The folder of a recording around ``stage.csv``."""
    folder = path.parent
    raw(folder / "events.raw")
    write_laser_yaml(folder / "laser.yaml", Modulation(70.0))
    save_calibration(load_calibration("config_3"), folder / "calibration.yaml")
    return load_recording(folder)


def copied(name):
    return lambda path: path.write_bytes((CONFIG / name).read_bytes())


def text(content):
    return lambda path: path.write_text(content)


FILES = {
    "calibration.yaml": (copied("config_3_as_built.yaml"), load_calibration),
    "laser.yaml": (
        lambda path: write_laser_yaml(path, Modulation(70.0, on_edge_us=5)),
        read_laser_yaml,
    ),
    "profile.yaml": (copied("awg_utg900e.yaml"), load_profile),
    "events.raw": (raw, decoded),
    "stage.csv": (stage, recording),
    "cloud.pcd": (cloud, read_cloud),
    "cloud.ply": (cloud, read_cloud),
    "targets.csv": (text("row,range_mm,label\n100,900,a\n300,1000,b\n"), read_targets),
    "posts.csv": (copied("posts.csv"), read_distances),
    "my.bias": (lambda path: save_bias_file(path, {"bias_fo": 3, "bias_hpf": 9}), load_bias_file),
}


def refusal(read, file):
    """The line in which a file is refused, ``None`` when it is read."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            read(file)
    except EschortyError as error:
        return str(error)


@pytest.mark.parametrize("name", FILES)
def test_a_mutated_file_ends_in_a_result_or_in_one_line(tmp_path, name):
    write, read = FILES[name]
    file = tmp_path / name
    write(file)
    read(file)
    lines = []
    print(f"seed {SEED}")
    for number, mutant in enumerate(mutations(file.read_bytes(), MUTANTS, SEED)):
        file.write_bytes(mutant)
        print(f"mutant {number}")
        lines.append(refusal(read, file))
    refused = [line for line in lines if line is not None]
    print(f"{len(refused)} of {MUTANTS} refused")
    assert refused
    for line in refused:
        assert "\n" not in line
        assert len(line) <= 300
        assert str(tmp_path) in line
