"""RAW files: old and new headers, damage that is named, files written for every reader."""

import os
from pathlib import Path

import numpy as np
import pytest
from streams import words_of

from eschorty_ros.core.base.errors import ArgumentError, FormatError
from eschorty_ros.core.evt3 import Decoder
from eschorty_ros.core.storage.raw_file import RawReader, RawWriter, write_events_raw

WORDS = words_of("8000 6064 002A 2805")
NEW = b"% evt 3.0\n% format EVT3;height=720;width=1280\n% geometry 1280x720\n% end\n"


def reader_of(tmp_path: Path, content: bytes) -> RawReader:
    path = tmp_path / "events.raw"
    path.write_bytes(content)
    return RawReader(path)


def test_new_header_without_warning(tmp_path: Path) -> None:
    reader = reader_of(tmp_path, NEW + WORDS)
    assert b"".join(reader) == WORDS
    assert (reader.header.width, reader.header.height) == (1280, 720)
    assert reader.header["evt"] == "3.0"
    assert set(reader.header) == {"evt", "format", "geometry"}
    assert reader.warnings == []


def test_old_header_without_end(tmp_path: Path) -> None:
    reader = reader_of(tmp_path, b"% Date 2020-01-01  10:00:00\n% evt 3.0\n" + WORDS)
    assert b"".join(reader.chunks(3)) == WORDS
    assert reader.header["Date"] == "2020-01-01 10:00:00"
    said = [("% end" in line, "geometry" in line) for line in reader.warnings]
    assert said == [(True, False), (False, True)]


def test_blanks_between_the_parts_of_the_format(tmp_path: Path) -> None:
    reader = reader_of(tmp_path, b"% format EVT3; height=480; width=640\n% end\n" + WORDS)
    assert reader.header.named_size == (640, 480)
    assert reader.warnings == []


def test_words_that_look_like_a_header_line(tmp_path: Path) -> None:
    data = b"% looks like a line\n"
    assert b"".join(reader_of(tmp_path, NEW + data)) == data


def test_chunks_have_the_size_asked_for(tmp_path: Path) -> None:
    reader = reader_of(tmp_path, NEW + WORDS * 10)
    assert [len(piece) for piece in reader.chunks(32)] == [32, 32, 16]


def test_a_mapped_file_gives_the_same_bytes(tmp_path: Path) -> None:
    reader = reader_of(tmp_path, NEW + WORDS * 5000 + b"?")
    pieces = list(reader.mapped(4096))
    assert {len(piece) for piece in pieces[:-1]} == {4096}
    assert b"".join(pieces) == WORDS * 5000 + b"?"
    assert "middle of a word" in reader.warnings[0]
    assert list(reader_of(tmp_path, NEW).mapped(4096)) == []


def test_a_mapped_file_that_becomes_shorter_is_named(tmp_path: Path) -> None:
    """Its pages that are gone would end the process."""
    reader = reader_of(tmp_path, NEW + WORDS * 2048)
    pieces = reader.mapped(4096)
    next(pieces)
    os.truncate(reader.path, 5000)
    with pytest.raises(FormatError, match=r"events\.raw became shorter while it was read"):
        next(pieces)


def test_odd_byte_is_a_warning(tmp_path: Path) -> None:
    reader = reader_of(tmp_path, NEW + WORDS[:-1])
    assert b"".join(reader) == WORDS[:-1]
    list(reader)
    assert len(reader.warnings) == 1
    assert "middle of a word" in reader.warnings[0]


@pytest.mark.parametrize(("content", "said"), [(NEW, "no events"), (WORDS, "no header")])
def test_a_header_or_events_alone_are_a_warning(tmp_path: Path, content: bytes, said: str) -> None:
    reader = reader_of(tmp_path, content)
    assert b"".join(reader) == content.removeprefix(NEW)
    assert said in reader.warnings[0]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "empty"),
        (b"\x89PNG\r\n\x1a\n" + bytes(range(256)), "no RAW header"),
        (b"\x1f\x8b" + bytes(99), "gzip; run gunzip on it"),
        (b"% Data file containing CD events.\n% Version 2\n" + bytes(range(256)), "not EVT3's"),
        (b"% evt 2.0\n% end\n", "EVT2, not EVT3"),
        (b"% evt 2.1\n% end\n", "EVT21, not EVT3"),
        (b"% format EVT21;height=720;width=1280\n% end\n", "EVT21, not EVT3"),
        (b"% format HISTO3D;height=320;width=320\n% end\n", "HISTO3D, not EVT3"),
        (b"% format EVT3\n% evt 2.0\n% end\n", "correct one of the two"),
        (NEW.replace(b"1280x720", b"640x480"), "1280x720 in format and 640x480 in geometry"),
        (b"% format EVT3\n% geometry big\n% end\n", "geometry 'big'"),
        (b"% format EVT3;width=1280\n% end\n", "format '1280xNone'"),
        (b"% format EVT3;height=720;wid", "header line without end"),
    ],
)
def test_wrong_files_are_named(tmp_path: Path, content: bytes, said: str) -> None:
    with pytest.raises(FormatError) as failure:
        reader_of(tmp_path, content)
    message = str(failure.value)
    assert said in message
    assert "events.raw" in message
    assert "\n" not in message


def test_written_file_reads_back(tmp_path: Path) -> None:
    path = tmp_path / "out.raw"
    with RawWriter(path) as writer:
        writer.write(WORDS)
        writer.write(b"")
        writer.write(WORDS)
    assert writer.bytes_written == 16
    reader = RawReader(path)
    assert b"".join(reader) == WORDS * 2
    assert reader.warnings == []
    assert {
        "serial_number": "00000000", "sensor_name": "IMX636", "system_ID": "49",
        "format": "EVT3;height=720;width=1280", "integrator_name": "Prophesee",
    }.items() <= dict(reader.header).items()  # fmt: skip
    keys = [line.split()[1] for line in path.read_bytes().split(b"% end\n")[0].splitlines()]
    assert keys == sorted(keys)


def test_events_of_another_camera_read_back_in_readout_order(tmp_path: Path) -> None:
    print("seed 5")
    rng = np.random.default_rng(5)
    n = (1 << 20) + 1000  # more than are encoded at once
    t = rng.permutation(n) * 20
    x, y, on = rng.integers(0, 346, n), rng.integers(0, 260, n), rng.random(n) < 0.5
    write_events_raw(tmp_path / "events.raw", t, x, y, on, columns=346, rows=260)
    reader = RawReader(tmp_path / "events.raw")
    assert (reader.header.width, reader.header.height) == (346, 260)
    assert reader.warnings == []
    events = Decoder(346, 260).decode(b"".join(reader))
    order = np.argsort(t)
    for read, written in zip((events.t, events.x, events.y, events.p), (t, x, y, on), strict=True):
        np.testing.assert_array_equal(read, written[order])


@pytest.mark.parametrize(
    ("events", "said"),
    [
        (([], [], [], []), "[0, 0, 0, 0] entries"),
        (([1, 2], [3, 4], [5, 6], [1]), "[2, 2, 2, 1] entries"),
        (([1 << 40], [3], [5], [1]), "t_us begins at 1099511627776; subtract that"),
        (([1764512000 * 10**9], [3], [5], [1]), "t_us begins at 1764512000000000000; subtract"),
        (([1, 1 << 61], [3, 4], [5, 6], [0, 1]), "t spans more than 2**40 us"),
        (([1, 1 << 33], [3, 4], [5, 6], [0, 1]), "stay within 3600000000 us"),
        (([0.5], [3], [5], [1]), "give one axis of integers"),
        (([1], [1280], [5], [1]), "column holds 1280; choose 0 to 1279"),
        (([1], [3], [5], [-1]), "polarity holds -1; choose 0 to 1"),
    ],
)
def test_wrong_events_leave_the_file_as_it_is(tmp_path: Path, events, said: str) -> None:
    (tmp_path / "events.raw").write_text("the last good one")
    with pytest.raises(ArgumentError) as caught:
        write_events_raw(tmp_path / "events.raw", *events, columns=1280, rows=720)
    assert said in str(caught.value)
    assert (tmp_path / "events.raw").read_text() == "the last good one"


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"absent\.raw: No such file"):
        RawReader(tmp_path / "absent.raw")
