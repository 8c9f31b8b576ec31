"""Recording folders: what is written is read back, what is wrong is named in one line."""

import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eschorty_ros.core.base.errors import ArgumentError, EschortyError, FormatError
from eschorty_ros.core.base.schema import Fault, FaultsError
from eschorty_ros.core.clocks import StageTrack
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import load_calibration, save_calibration
from eschorty_ros.core.reconstruction import recorded_settings
from eschorty_ros.core.storage import (
    TRUTH_DTYPE,
    load_recording,
    read_laser_yaml,
    write_laser_yaml,
    write_stage_csv,
    write_truth_csv,
)

EPOCH_US = 1_760_000_000_000_000


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "events.raw").write_bytes(b"")
    write_stage_csv(tmp_path / "stage.csv", [0, 1000, 3000], [0.0, 0.05, 0.15])
    write_laser_yaml(tmp_path / "laser.yaml", Modulation(70.0, on_edge_us=12))
    save_calibration(load_calibration("config_3"), tmp_path / "calibration.yaml")
    return tmp_path


def test_a_recording_whose_process_was_killed_at_once_says_so(folder):
    (folder / "stage.csv").write_text("t_us,position_mm\n")
    edit("scan.yaml", SCAN)(folder)
    with pytest.raises(FormatError, match=r"stage samples: 0; .*; the recording was not ended"):
        load_recording(folder)


def test_a_complete_folder(folder):
    recording = load_recording(str(folder))
    assert recording.path == folder
    assert recording.events_path == folder / "events.raw"
    assert recording.modulation == Modulation(70.0, 0.5, "square", 12)
    assert recording.calibration == load_calibration("config_3")
    assert recording.truth is None
    assert recording.stage_samples["t_us"].tolist() == [0, 1000, 3000]
    assert recording.stage.position_mm([0, 500, 2000, 3000]).tolist() == [0.0, 0.025, 0.1, 0.15]
    assert np.isnan(recording.stage.position_mm([-1, 3001])).all()


def test_given_values_stand_in_for_missing_files(folder):
    (folder / "calibration.yaml").unlink()
    (folder / "laser.yaml").unlink()
    recording = load_recording(folder, load_calibration("config_1"), 300.0)
    assert recording.calibration == load_calibration("config_1")
    assert recording.modulation == Modulation(300.0)
    (folder / "events.raw").rename(folder / "events.raw.gz")
    with pytest.raises(FormatError, match=r"events.raw \(run gunzip on events.raw.gz\)"):
        load_recording(folder)


def test_every_missing_file_is_named_beside_a_long_path(tmp_path):
    (tmp_path / "the_first_scan_of_the_day").mkdir()
    with pytest.raises(FormatError) as caught:
        load_recording(tmp_path / "the_first_scan_of_the_day")
    assert str(caught.value).endswith(
        "events.raw, stage.csv, laser.yaml (or reconstruct --frequency), calibration.yaml (or "
        "reconstruct --calibration); docs/python.md shows how to add them"
    )


def test_a_bag_is_to_be_converted(tmp_path):
    (tmp_path / "metadata.yaml").touch()
    with pytest.raises(FormatError, match="is a bag; make a recording of it by `eschorty convert`"):
        load_recording(tmp_path)


def test_layout_of_the_written_files(folder):
    assert (folder / "stage.csv").read_text() == (
        "t_us,position_mm\n0,0.000000\n1000,0.050000\n3000,0.150000\n"
    )
    assert (folder / "laser.yaml").read_text() == (
        "frequency_hz: 70.0\nduty: 0.5\nwaveform: square\non_edge_us: 12\n"
    )
    write_truth_csv(folder / "truth.csv", [7, 8], np.array([0, 1279], np.uint16), [1320, 1.5])
    assert (folder / "truth.csv").read_text() == (
        "t_us,column,range_mm\n7,0,1320.000000\n8,1279,1.500000\n"
    )


def test_truth_is_read_on_first_use(folder):
    recording = load_recording(folder)
    write_truth_csv(folder / "truth.csv", [EPOCH_US + 1], [640], [1320.123456])
    truth = recording.truth
    assert truth.dtype == TRUTH_DTYPE
    assert truth.tolist() == [(EPOCH_US + 1, 640, 1320.123456)]
    assert recording.truth is truth


def test_large_truth_survives_chunked_writing(folder):
    count = 70_001
    t_us = EPOCH_US + np.arange(count)
    write_truth_csv(folder / "truth.csv", t_us, np.arange(count) % 1280, np.full(count, 900.5))
    truth = load_recording(folder).truth
    assert np.array_equal(truth["t_us"], t_us)
    assert np.array_equal(truth["column"], np.arange(count) % 1280)


def test_empty_truth_is_an_empty_table(folder):
    write_truth_csv(folder / "truth.csv", [], [], [])
    assert len(load_recording(folder).truth) == 0


@settings(derandomize=True, max_examples=60, deadline=None)
@given(st.lists(st.floats(-1e5, 1e5), min_size=2, max_size=30))
def test_positions_through_text_and_through_ros_metres_are_identical(tmp_path_factory, positions):
    file = tmp_path_factory.mktemp("text") / "stage.csv"
    t_us = EPOCH_US + 10 * np.arange(len(positions))
    write_stage_csv(file, t_us, positions)
    rows = [line.split(",") for line in file.read_text().splitlines()[1:]]
    from_text, from_ros = StageTrack(), StageTrack()
    from_text.append([int(row[0]) for row in rows], [float(row[1]) for row in rows])
    from_ros.append(t_us, [position * 1e-3 * 1e3 for position in positions])
    query = np.arange(t_us[0], t_us[-1] + 1)
    assert from_text.position_mm(query).tobytes() == from_ros.position_mm(query).tobytes()


@pytest.mark.parametrize("on_edge_us", [None, 0, -5, EPOCH_US])
def test_laser_round_trip(tmp_path, on_edge_us):
    modulation = Modulation(69.99731, 0.3, "sine", on_edge_us)
    write_laser_yaml(tmp_path / "laser.yaml", modulation)
    assert read_laser_yaml(tmp_path / "laser.yaml") == modulation


def test_spaces_blank_lines_and_windows_endings_are_fine(folder):
    (folder / "stage.csv").write_bytes(
        b"\xef\xbb\xbft_us, position_mm\r\n0, 1.5\r\n\r\n9,2\r\n\r\n"
    )
    assert load_recording(folder).stage_samples.tolist() == [(0, 1.5), (9, 2.0)]


def test_calibration_may_be_a_bare_name(folder):
    (folder / "calibration.yaml").write_text("config_1\n")
    assert load_recording(folder).calibration == load_calibration("config_1")


def edit(name: str, text: str) -> Callable[[Path], int]:
    return lambda folder: (folder / name).write_text(text)


def remove(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


LASER = "frequency_hz: 70.0\nduty: 0.5\nwaveform: square\n"


SCAN = "scan_id: a\nstart_mm: 1\nstop_mm: 2\n"


def test_settings_beyond_what_the_laser_allows_are_used_as_the_nodes_do(folder):
    (folder / "settings.yaml").write_text("periods_per_profile: 1000\n")
    assert recorded_settings(load_recording(folder)).periods_per_profile == 145


def test_faults_survive_the_way_from_another_process():
    error = FaultsError([Fault(("start_mm",), " is 'x'; write a number")] * 2)
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


@pytest.mark.parametrize(
    ("damage", "parts"),
    [
        (
            edit("scan.yaml", SCAN + "stage_gap_s: 1.0e+305\n"),
            ["scan.yaml", "stage_gap_s is 1e+305"],
        ),
        (edit("scan.yaml", SCAN + "stage_gap_s: -5\n"), ["scan.yaml", "stage_gap_s is -5"]),
        (remove("events.raw"), ["is events.raw; docs/python.md"]),
        (
            lambda folder: [(folder / f"{n}").unlink() for n in ("stage.csv", "laser.yaml")],
            ["are stage.csv, laser.yaml (or reconstruct --frequency);"],
        ),
        (remove("calibration.yaml"), ["is calibration.yaml (or reconstruct --calibration)"]),
        (edit("stage.csv", "time,pos\n0,1\n"), ["line 1", "time,pos", "t_us,position_mm"]),
        (edit("stage.csv", "\n"), ["stage.csv line 1", "t_us,position_mm"]),
        (edit("stage.csv", "t_us,position_mm\n"), ["stage.csv", "samples: 0", "two or more"]),
        (edit("stage.csv", "t_us,position_mm\n0,1\n"), ["samples: 1", "twice where"]),
        (edit("stage.csv", "t_us,position_mm\n0,1\n\n5,2\n3,3\n"), ["line 5", "from 5 to 3"]),
        (edit("stage.csv", "t_us,position_mm\n5,2\n5,3\n"), ["line 3", "from 5 to 5"]),
        (edit("stage.csv", "t_us,position_mm\n0,1\n5,abc\n"), ["line 3", "position_mm is 'abc'"]),
        (edit("stage.csv", "t_us,position_mm\n0,1\n5.5,2\n"), ["line 3", "t_us is '5.5'", "whole"]),
        (edit("stage.csv", "t_us,position_mm\n0,1\n5.0,2\n"), ["line 3", "t_us is '5.0'", "whole"]),
        (edit("stage.csv", "t_us,position_mm\n0,1\n5\n"), ["line 3", "1 cells"]),
        (edit("stage.csv", "t_us,position_mm\n0,1\n5,2,3\n"), ["line 3", "3 cells"]),
        (edit("stage.csv", "t_us,position_mm\n0,nan\n"), ["line 2", "position_mm is nan"]),
        (edit("stage.csv", "t_us,position_mm\n0,1\n1,1e300\n"), ["line 3", "1e+300"]),
        (edit("stage.csv", f"t_us,position_mm\n{2**70},1\n"), ["line 2", "t_us is", "in range"]),
        (edit("laser.yaml", LASER + "phase: 3\n"), ["laser.yaml", "phase is 3", "remove it"]),
        (edit("laser.yaml", LASER + "on_edge_u: 3\n"), ["did you mean on_edge_us?"]),
        (edit("laser.yaml", LASER + "on_edge_us: 3.5\n"), ["laser.yaml", "on_edge_us is 3.5"]),
        (edit("laser.yaml", LASER.replace("70.0", "7.0")), ["laser.yaml", "frequency_hz is 7.0"]),
        (edit("laser.yaml", LASER.replace("70.0", "fast")), ["frequency_hz is 'fast'", "number"]),
        (edit("laser.yaml", LASER.replace("0.5", "1.5")), ["laser.yaml", "duty is 1.5"]),
        (edit("laser.yaml", LASER.replace("square", "saw")), ["waveform is 'saw'", "square"]),
        (edit("laser.yaml", LASER + "duty: 0.4\n"), ["laser.yaml line 4", "'duty' appears twice"]),
        (edit("laser.yaml", ""), ["laser.yaml", "None", "frequency_hz"]),
        (edit("calibration.yaml", "name: x\n"), ["calibration.yaml", "is missing"]),
    ],
)
def test_damage_is_named_in_one_line(folder, damage, parts):
    damage(folder)
    with pytest.raises(EschortyError) as caught:
        load_recording(folder)
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert part in message


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("t_us,column,range_mm\n1,-1,900\n", "column is '-1'"),
        ("t_us,column,range_mm\n1,70000,900\n", "column is '70000'"),
        ("t_us,column,range_mm\n1,5,nan\n", "range_mm is nan"),
        ("t_us,column\n", "line 1"),
    ],
)
def test_damaged_truth_is_named(folder, text, part):
    (folder / "truth.csv").write_text(text)
    recording = load_recording(folder)
    with pytest.raises(FormatError, match=part):
        _ = recording.truth


def test_binary_in_place_of_text_is_named(folder):
    (folder / "stage.csv").write_bytes(bytes(range(256)))
    with pytest.raises(FormatError, match=r"stage\.csv.*not text"):
        load_recording(folder)


def test_writers_refuse_what_readers_would(tmp_path):
    file = tmp_path / "x.csv"
    with pytest.raises(ArgumentError, match="from 5 to 5"):
        write_stage_csv(file, [5, 5], [1.0, 2.0])
    with pytest.raises(ArgumentError, match="one length"):
        write_stage_csv(file, [5, 6], [1.0])
    for few in ([], [5]):
        with pytest.raises(ArgumentError, match=f"{len(few)} samples; give two or more"):
            write_stage_csv(file, few, few)
    with pytest.raises(ArgumentError, match=r"modulation is 70\.0; give a Modulation"):
        write_laser_yaml(file, 70.0)
    assert list(tmp_path.iterdir()) == []
