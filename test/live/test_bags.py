"""Bags of both storages: to a recording and back, the points stay the same."""

import contextlib
import re
import resource
import shutil
import sqlite3
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from time import sleep

import numpy as np
import pytest
import recorded_scan
from click.testing import CliRunner
from recorded_scan import LiveScan
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from eschorty_ros.cli import main
from eschorty_ros.core.base.errors import EschortyError
from eschorty_ros.core.optics import load_calibration, save_calibration
from eschorty_ros.core.reconstruction import reconstruct_recording
from eschorty_ros.core.storage import ScanLog, load_recording
from eschorty_ros.live import bag_files
from eschorty_ros.live.bag_conversion import bag_to_recording, recording_to_bag

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return recorded_scan.source(tmp_path_factory.mktemp("source") / "rec")


@pytest.fixture(scope="module")
def scanned(source, tmp_path_factory):
    """A recorded scan without some packets: its phase is estimated, from the laser's start on."""
    folder = tmp_path_factory.mktemp("scanned") / "rec"
    scan = LiveScan(source, folder, lost=(40, 41, 46))
    scan.run()
    scan.recorder.wait(10.0)
    return load_recording(folder)


def points(recording):
    return reconstruct_recording(recording).points


def bag_messages(recording, bag):
    recording_to_bag(recording, bag)
    with bag_files.BagReader(bag) as written:
        return list(written.messages(*bag_files.TOPICS))


def write_messages(bag, messages, custom):
    with bag_files.BagWriter(bag, "mcap", custom) as target:
        for message in messages:
            names = message.fields.__dataclass_fields__.keys() - {"__msgtype__"}
            fields = {name: getattr(message.fields, name) for name in names}
            target.write(message.kind, message.t_ns, **fields)


def test_a_conversion_that_is_killed_leaves_a_recording_that_was_not_ended(
    tmp_path, scanned, monkeypatch
):
    bag, folder, killed = tmp_path / "bag", tmp_path / "rec", tmp_path / "killed"
    recording_to_bag(scanned, bag)
    messages = bag_files.BagReader.messages

    def copied_after_the_last(self, *kinds):
        yield from messages(self, *kinds)
        if bag_files.ODOMETRY in kinds:
            while not (folder / "scan.yaml").exists():
                sleep(0.01)
            shutil.copytree(folder, killed, ignore=shutil.ignore_patterns(".*-partial"))

    monkeypatch.setattr(bag_files.BagReader, "messages", copied_after_the_last)
    bag_to_recording(bag, folder)
    assert "state: recording" in (killed / "scan.yaml").read_text()
    assert "state: ended" in (folder / "scan.yaml").read_text()


@pytest.mark.parametrize("storage", bag_files.STORAGES)
@pytest.mark.parametrize("which", ["source", "scanned"])
def test_a_recording_a_bag_and_back(tmp_path, request, which, storage):
    recording = request.getfixturevalue(which)
    recording_to_bag(recording, tmp_path / "bag", storage)
    assert bag_files.is_bag(tmp_path / "bag")
    lost = "3 packets of the recording were lost on the way" if which == "scanned" else ""
    assert lost in bag_to_recording(tmp_path / "bag", tmp_path / "again")
    again = load_recording(tmp_path / "again")
    expected = points(recording)
    assert len(expected) > 500
    np.testing.assert_array_equal(points(again), expected)
    assert again.modulation == recording.modulation
    assert again.calibration == recording.calibration


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"reason": "camera: gone"}, "camera: gone"),
        ({"reason": "disk", "packets_left_out": 2}, "2 packets are not recorded: disk"),
        ({"state": "recording"}, "the recording was not ended"),
    ],
)
def test_what_a_recording_lacks_is_in_that_of_its_bag(tmp_path, source, change, words):
    log = ScanLog(scan_id="s", start_mm=10.0, stop_mm=20.0, **{"state": "ended", **change})
    recording_to_bag(replace(source, scan=log), tmp_path / "bag")
    bag_to_recording(tmp_path / "bag", tmp_path / "again")
    again = load_recording(tmp_path / "again").scan
    assert again.state == "ended"
    assert again.reason.startswith(words)


def test_an_interrupted_conversion_leaves_no_bag(tmp_path, source):
    def interrupt(share, note):
        if share > 0.3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        recording_to_bag(source, tmp_path / "bag", progress=interrupt)
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_is_full_at_the_end_leaves_no_bag(tmp_path, source, monkeypatch):
    close_fully = Writer.close

    def close(writer):
        close_fully(writer)
        raise OSError("no space left on device")

    monkeypatch.setattr(Writer, "close", close)
    with pytest.raises(EschortyError, match="no space"):
        recording_to_bag(source, tmp_path / "bag")
    assert not (tmp_path / "bag").exists()


def test_a_disk_that_is_full_leaves_no_recording(tmp_path, source):
    recording_to_bag(source, tmp_path / "bag")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    # Python ignores the signal, and the write fails as on a full disk.
    resource.setrlimit(resource.RLIMIT_FSIZE, (source.events_path.stat().st_size // 2, before[1]))
    try:
        with pytest.raises(EschortyError, match="File too large; free some space"):
            bag_to_recording(tmp_path / "bag", tmp_path / "again")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not (tmp_path / "again").exists()


def test_a_stage_in_unix_time_gives_no_bag(tmp_path, source):
    samples = source.stage_samples.copy()
    samples["t_us"] += 1_700_000_000_000_000
    with pytest.raises(EschortyError, match="in the sensor's time"):
        recording_to_bag(replace(source, stage_samples=samples), tmp_path / "bag")
    assert not (tmp_path / "bag").exists()


def test_a_bag_of_another_camera_driver_needs_frequency_and_calibration(tmp_path, source):
    """Only the driver's events and an odometry, and no clock but the packets' stamps."""
    recording = replace(source, modulation=replace(source.modulation, on_edge_us=None))
    recording_to_bag(recording, tmp_path / "all")
    topics = {bag_files.EVENTS: "/event_camera/events", bag_files.ODOMETRY: "/rail/odometry"}
    with bag_files.BagReader(tmp_path / "all") as bag:
        messages = list(bag.messages(*topics))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bag_files, "TOPICS", bag_files.TOPICS | topics)
        write_messages(tmp_path / "bag", messages, {})
    for options, words in (({}, "give --frequency"), ({"frequency_hz": 70.0}, "--calibration")):
        with pytest.raises(EschortyError, match=words):
            bag_to_recording(tmp_path / "bag", tmp_path / "none", **options)
    build = source.calibration
    bag_to_recording(tmp_path / "bag", tmp_path / "rec", build, 70.0)
    found, expected = points(load_recording(tmp_path / "rec")), points(recording)
    np.testing.assert_array_equal(found["x"], expected["x"])
    # A stamp is that of the packet's first bytes, exact here but for its 10 ms rhythm.
    np.testing.assert_allclose(found["y"], expected["y"], atol=1e-4, rtol=0)
    save_calibration(build, tmp_path / "build.yaml")
    options = "--frequency", "70", "--calibration", str(tmp_path / "build.yaml")
    command = "convert", str(tmp_path / "bag"), str(tmp_path / "sent"), *options
    assert CliRunner().invoke(main, command).exit_code == 0
    # A camera that collects events for 4 ms sends them so much later, at 50 mm/s.
    sent = points(load_recording(tmp_path / "sent"))
    assert np.median(sent["y"] - found["y"]) == pytest.approx(-2e-4, abs=1e-6)


@pytest.mark.parametrize(
    ("key", "text", "words"),
    [
        ("eschorty_scan", "{start: 0}", "start is 0, and no such key exists"),
        ("eschorty_scan", "{start_mm: near}", "start_mm is 'near'"),
        ("eschorty_settings", "{method: mean}", "'method' is no setting"),
        ("eschorty_settings", "{centroid: best}", "centroid is 'best'"),
    ],
)
def test_wrong_metadata_of_a_bag_is_one_line(tmp_path, source, key, text, words):
    messages = bag_messages(source, tmp_path / "bag")
    write_messages(tmp_path / "wrong", messages, {key: text})
    with pytest.raises(EschortyError, match=words):
        bag_to_recording(tmp_path / "wrong", tmp_path / "rec")


def test_a_camera_that_restarts_within_a_bag_ends_the_recording(tmp_path, source):
    messages = bag_messages(source, tmp_path / "bag")
    bag_to_recording(tmp_path / "bag", tmp_path / "once")
    expected = points(load_recording(tmp_path / "once"))
    for message in list(messages):
        again = replace(message, t_ns=message.t_ns + 10 * 10**9, fields=deepcopy(message.fields))
        for time in (again.fields.header.stamp, getattr(again.fields, "phase_epoch", None)):
            if time is not None:
                time.sec += 10
        messages.append(again)
    write_messages(tmp_path / "twice", messages, {})
    lacks = bag_to_recording(tmp_path / "twice", tmp_path / "rec")
    assert "packets are not recorded: camera, modulation or settings were changed" in lacks
    np.testing.assert_array_equal(points(load_recording(tmp_path / "rec")), expected)


def write_changed(bag, recording, kind, field, value):
    """A bag of a recording whose messages of a kind all have this value in a field."""
    messages = bag_messages(recording, bag.with_name("bag"))
    for message in messages:
        if message.kind == kind:
            setattr(message.fields, field, value)
    write_messages(bag, messages, {})


def test_a_laser_without_a_frequency_is_named(tmp_path, source):
    write_changed(tmp_path / "off", source, bag_files.LASER, "frequency", 0.0)
    with pytest.raises(EschortyError, match=r"off: laser/state: .* 0\.0; .* give --freq"):
        bag_to_recording(tmp_path / "off", tmp_path / "rec")
    bag_to_recording(tmp_path / "off", tmp_path / "rec", frequency_hz=70.0)


def test_losses_of_a_bag_are_one_warning_and_a_scan_without_limits_has_none(tmp_path, scanned):
    messages = bag_messages(scanned, tmp_path / "bag")
    write_messages(tmp_path / "lost", messages, {})
    done = CliRunner().invoke(main, ["reconstruct", str(tmp_path / "lost")])
    assert (done.exit_code, done.output.count("were lost on the way")) == (0, 1), done.output
    converted = CliRunner().invoke(main, ["convert", f"{tmp_path}/lost", f"{tmp_path}/rec"])
    assert converted.exit_code == 0, converted.output
    shown = CliRunner().invoke(main, ["info", str(tmp_path / "rec" / "scan.yaml")]).stdout
    assert ("lost" in shown, "mm" in shown) == (True, False)


def test_packets_that_the_driver_does_not_number_are_refused(tmp_path, source):
    write_changed(tmp_path / "same", source, bag_files.EVENTS, "seq", 0)
    with pytest.raises(EschortyError, match="seq of the event packets does not increase from 0"):
        bag_to_recording(tmp_path / "same", tmp_path / "rec")


def test_a_conversion_that_fails_leaves_no_recording(tmp_path, source):
    messages = bag_messages(source, tmp_path / "bag")
    last = next(m for m in reversed(messages) if m.kind == bag_files.EVENTS)
    last.fields.encoding = "evt2"
    write_messages(tmp_path / "wrong", messages, {})
    with pytest.raises(EschortyError, match="encoding is 'evt2'"):
        bag_to_recording(tmp_path / "wrong", tmp_path / "rec")
    assert not (tmp_path / "rec").exists()


def test_a_bag_of_a_smaller_camera_is_refused(tmp_path, source):
    recording_to_bag(source, tmp_path / "bag")
    with pytest.raises(EschortyError, match="of a sensor of 64 x 720 and nominal of one of 1280"):
        bag_to_recording(tmp_path / "bag", tmp_path / "rec", load_calibration("nominal"))


@pytest.mark.parametrize(
    ("topics", "chosen"),
    [
        (["/mobile_stage/odom", "/stage/odom"], "/stage/odom"),
        (["/mobile_stage/odom"], "/mobile_stage/odom"),
        (["/mobile_stage/odom", "/linear/odom"], None),
    ],
)
def test_a_topic_is_ours_by_its_whole_name_or_the_only_one(tmp_path, topics, chosen):
    store = get_typestore(Stores.ROS2_JAZZY)
    with Writer(tmp_path / "bag", version=8, storage_plugin=StoragePlugin.MCAP) as target:
        for topic in topics:
            made = target.add_connection(topic, bag_files.ODOMETRY, typestore=store)
            if topic == chosen:
                target.write(made, 1, b"any")
    two = pytest.raises(EschortyError, match="on /linear/odom, /mobile_stage/odom; leave one")
    with contextlib.nullcontext() if chosen else two, bag_files.BagReader(tmp_path / "bag") as bag:
        assert bag_files.ODOMETRY in bag


def test_a_bag_without_its_metadata_is_read_where_it_is_one_file(tmp_path, source):
    messages = bag_messages(source, tmp_path / "bag")
    [file] = (tmp_path / "bag").glob("*.mcap")
    (tmp_path / "bag" / "metadata.yaml").unlink()
    assert bag_files.is_bag(tmp_path / "bag")
    with bag_files.BagReader(tmp_path / "bag") as bag:
        assert len(list(bag.messages(*bag_files.TOPICS))) == len(messages)
    second = file.rename(file.with_name("b.mcap.zstd"))
    for path, words in ((second, "run unzstd on it"), (tmp_path / "bag", "2 files of bags and no")):
        with pytest.raises(EschortyError, match=words):
            bag_files.BagReader(path)
        file.write_bytes(b"")


def test_the_name_of_a_recordings_folder_makes_it_no_bag(tmp_path, source):
    folder = shutil.copytree(source.path, tmp_path / "rec.mcap")
    (folder / "scan.mcap").touch()
    assert not bag_files.is_bag(folder)


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r\n", bytes(1000)])
def test_a_damaged_bag_is_one_line(tmp_path, content):
    for name in ("bag.mcap", "bag.db3"):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(EschortyError, match=f"{name}: .*; repair it: a cut .mcap with `mcap"):
            bag_to_recording(tmp_path / name, tmp_path / "rec")


def test_the_definitions_are_those_of_the_message_files():
    for kind, text in bag_files.DEFINITIONS.items():
        package, _, name = kind.split("/")
        folder = ROOT if package == "eschorty_ros" else ROOT / "external_msgs" / package
        file = (folder / "msg" / f"{name}.msg").read_text()
        assert get_types_from_msg(text, kind) == get_types_from_msg(file, kind)


def test_a_bag_is_read_without_its_definitions_and_refused_with_other_messages(tmp_path, source):
    """ROS writes definitions as IDL that the library cannot parse, such as EventPacket's."""
    recording_to_bag(source, tmp_path / "bag", "sqlite3")
    [file] = (tmp_path / "bag").glob("*.db3")

    def change(table, column, value):
        with contextlib.closing(sqlite3.connect(file)) as base, base:
            assert base.execute(f"UPDATE {table} SET {column} = ?", (value,)).rowcount

    change("message_definitions", "encoded_message_definition", '@verbatim #include "x.idl"')
    bag_to_recording(tmp_path / "bag", tmp_path / "again")
    np.testing.assert_array_equal(points(load_recording(tmp_path / "again")), points(source))
    other = "RIHS01_" + 64 * "0"
    change("topics", "type_description_hash", other)
    listed = tmp_path / "bag" / "metadata.yaml"
    listed.write_text(re.sub("RIHS01_[0-9a-f]{64}", other, listed.read_text()))
    with pytest.raises(EschortyError, match="than this version"):
        bag_to_recording(tmp_path / "bag", tmp_path / "no")
