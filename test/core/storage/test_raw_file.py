"""RAW files: old and new headers, damage that is named, files written for every reader."""

import os
from pathlib import Path

import pytest
from streams import words_of

from eschorty_ros.core.base.errors import FormatError
from eschorty_ros.core.storage.raw_file import RawReader, RawWriter

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


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"absent\.raw: No such file"):
        RawReader(tmp_path / "absent.raw")
