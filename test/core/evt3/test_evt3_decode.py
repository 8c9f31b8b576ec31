"""EVT3 decoding: known answers, time rules, grammar, an independent oracle, any split."""

import hashlib
import os
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from evt3_oracle import SlowDecoder
from from_python import from_python
from hypothesis import given, settings
from hypothesis import strategies as st
from streams import RECORDING_SHARES, recording_like_words, words_of

from eschorty_ros.core import evt3
from eschorty_ros.core.evt3.events import event_arrays
from eschorty_ros.core.evt3.state_machine import _decode_stored, _trigger_arrays
from eschorty_ros.core.storage.raw_file import RawReader

decode_stored = from_python(_decode_stored)
RECORDING = Path(os.environ.get("EVT3_RECORDING", ""))


def decoded(data: bytes) -> tuple[list, list, evt3.Counters]:
    decoder = evt3.Decoder()
    events = decoder.decode(data)
    return events.packed().tolist(), trigger_list(events), decoder.counters


def trigger_list(events: evt3.Events) -> list:
    values = (getattr(events.triggers, name).tolist() for name in ("t", "channel", "edge"))
    return list(zip(*values, strict=True))


KNOWN = [
    ("8000 6064 002A 2805", [(100, 5, 42, 1)]),
    ("8000 6064 002A 3040 4801 4000 5080 4001", [(100, x, 42, 0) for x in (64, 75, 95, 96)]),
    ("8000 6064 002A 3040 2805 4001", [(100, 5, 42, 1), (100, 64, 42, 0)]),
    (
        "8000 6064 002A 2805 6FFF 2806 8001 6003 2807",
        [(100, 5, 42, 1), (4095, 6, 42, 1), (4099, 7, 42, 1)],
    ),
    ("8FFF 6FFF 002A 2805 8000 6000 2805", [(16777215, 5, 42, 1), (16777216, 5, 42, 1)]),
    (
        "8005 6000 002A 2805 8003 6000 2805 8006 6001 2805",
        [(t, 5, 42, 1) for t in (20480, 20480, 24577)],
    ),
    ("8000 6064 002A 2805 8000 2806", [(100, 5, 42, 1), (100, 6, 42, 1)]),
    ("8000 6064 02D0 2805 002A 2805", [(100, 5, 42, 1)]),
    # The sensor takes a TIME_LOW back before any event used it: no clamp.
    ("8000 602B 6020 002A 2805", [(32, 5, 42, 1)]),
    # A changed TIME_HIGH zeroes the low bits.
    ("8000 6FFF 002A 2805 8001 2805", [(4095, 5, 42, 1), (4096, 5, 42, 1)]),
    # One flipped top bit is no wrap, the outlier is dropped, the clock goes on.
    (
        "8800 6001 002A 2805 8000 2806 8800 6002 2807",
        [(8388609, 5, 42, 1), (8388609, 6, 42, 1), (8388610, 7, 42, 1)],
    ),
    # A forward jump counts once the next two TIME_HIGH confirm it, and nothing is broken between.
    (
        "8001 002A 2805 8400 6005 2806 8400 2807 8401 2808",
        [(t, y, 42, 1) for t, y in ((4096, 5), (4101, 6), (4101, 7), (4198400, 8))],
    ),
    (
        "8001 6005 002A 2805 8400 8400 9000 8401 6006 2806 8002 2807",
        [(4101, 5, 42, 1), (4102, 6, 42, 1), (8192, 7, 42, 1)],
    ),
    # Disorder of a few us around a TIME_HIGH and around the wrap: time stands, never jumps.
    (
        "8FFF 6FFE 002A 2805 8000 6003 2805 8FFF 6FFF 2805 8000 6005 2805",
        [(t, 5, 42, 1) for t in (16777214, 16777219, 16777219, 16777221)],
    ),
]


@pytest.mark.parametrize(("text", "expected"), KNOWN)
def test_known_answers(text: str, expected: list) -> None:
    assert decoded(words_of(text))[0] == expected
    slow = SlowDecoder()
    slow.feed([int(word, 16) for word in text.split()])
    assert slow.events == expected


def test_triggers_take_the_current_time() -> None:
    events, triggers, counters = decoded(words_of("8000 6064 A001 60C8 A100"))
    assert (events, triggers) == ([], [(100, 0, 1), (200, 1, 0)])
    assert counters.triggers == 2


def test_others_and_sensor_drop_words() -> None:
    text = "8000 E016 F123 F456 7007 E014 F005 ED6A EED6 EED8 EEDA EEDA 6001"
    counters = decoded(words_of(text))[2]
    assert (counters.erc_events_out, counters.erc_events_in) == (0x7456123, 5)
    assert (counters.sensor_dropped_time_low, counters.sensor_dropped_time_high) == (1, 1)
    assert (counters.sensor_dropped_events, counters.sensor_drop_words) == (2, 4)
    assert counters.broken_continuations == 1


@pytest.mark.parametrize(
    ("text", "counts"),
    [
        ("002A 2805 3000 4FFF 50FF 8000", {"events_before_time": 21, "words_before_time": 5}),
        ("8000 2805", {"x_without_y": 1, "events_without_y": 1, "events_dropped": 1}),
        ("8000 102A 2805", {"legacy_y_words": 1, "events_without_y": 1}),
        ("8000 02D0 2805 2806", {"y_past_height": 1, "events_without_y": 2, "x_without_y": 0}),
        ("8000 002A 2500", {"events_past_width": 1}),
        ("8000 002A 34F8 4FFF 4FFF 50FF", {"events_past_width": 24, "events": 8}),
        ("8000 002A 4001", {"vectors_without_base": 1, "events_without_base": 1}),
        ("8000 002A 3000 4001 002A", {"broken_triples": 1, "events": 1}),
        ("8000 002A 3000 4001 4001 4001 4001 5001", {"broken_triples": 1, "events": 5}),
        ("8000 002A 3000 5001", {"broken_triples": 1, "events": 1}),
        ("8000 7001 F001", {"broken_continuations": 2}),
        ("8000 9123 B000 C000 D000", {"unknown_words": 4}),
        ("8005 8003 6001 002A 2001", {"time_high_back": 1}),
        ("8005 8400 8006", {"time_high_dropped": 1, "time_high_jumps": 0}),
        ("8005 8400 8400 8401", {"time_high_dropped": 0, "time_high_jumps": 1}),
        ("8005 8400 8400 8006", {"time_high_dropped": 1, "time_high_jumps": 0}),
        ("8000 6005 002A 2805 6004 2805", {"time_low_back": 1, "events": 2}),
    ],
)
def test_counters(text: str, counts: dict[str, int]) -> None:
    found = asdict(decoded(words_of(text))[2])
    assert {name: found[name] for name in counts} == counts


def test_odd_byte_is_carried() -> None:
    decoder = evt3.Decoder()
    data = words_of("8000 6064 002A 2805")
    assert len(decoder.decode(data[:7])) == 0
    assert decoder.counters.odd_byte == 1
    assert decoder.decode(data[7:]).packed().tolist() == [(100, 5, 42, 1)]
    assert decoder.counters.odd_byte == 0


def test_many_wraps_stay_in_int64() -> None:
    words = [0x8000 | high & 0xFFF for high in range(0, 300 * 4096, 2)]
    decoder = evt3.Decoder()
    events = decoder.decode(np.array([*words, 0x6007, 0x0001, 0x2001], "<u2").view(np.uint8))
    assert events.t.tolist() == [((300 * 4096 - 2) << 12) + 7]


def test_known_gap_keeps_the_epoch_and_takes_the_first_time() -> None:
    decoder = evt3.Decoder()
    decoder.decode(words_of("8FFF 002A 2805 8000 6001 3010"))
    decoder.note_gap()
    data = words_of("002A 2805 8400 2805 4001 0001 2805")
    assert decoder.decode(data).packed().tolist() == [(0x1000000 + (0x400 << 12), 5, 1, 1)]
    counters = decoder.counters
    assert (counters.gaps, counters.events_before_time, counters.x_without_y) == (1, 1, 1)
    assert (counters.vectors_without_base, counters.events_dropped) == (1, 3)


def test_time_without_events() -> None:
    decoder = evt3.Decoder()
    assert decoder.time_us is None
    decoder.decode(words_of("8001 6005"))
    assert decoder.time_us == 4101


def test_unaligned_and_read_only_input() -> None:
    data = bytearray(b"\0" + words_of("8000 6064 002A 2805"))
    assert len(evt3.Decoder().decode(memoryview(data)[1:])) == 1
    assert len(evt3.Decoder().decode(np.frombuffer(data, np.uint8)[1:])) == 1
    assert len(evt3.Decoder().decode(b"")) == 0


def assert_same_as_oracle(words: list[int]) -> None:
    slow = SlowDecoder()
    slow.feed(words)
    events, triggers, counters = decoded(np.array(words, dtype="<u2").tobytes())
    assert events == slow.events
    assert triggers == slow.triggers
    found = {name: count for name, count in asdict(counters).items() if count}
    assert found == {name: count for name, count in slow.counts.items() if count}


def any_words() -> st.SearchStrategy[list[int]]:
    kinds = st.sampled_from([0, 0, 0, 1, 2, 2, 3, 4, 4, 4, 4, 5, 5, 6, 6, 7, 8, 8, 9, 10, 14, 15])
    payload = st.one_of(
        st.integers(0, 4095),
        st.integers(0, 8),
        st.sampled_from([0x14, 0x16, 0xED6, 0xED8, 0xEDA, 719, 720, 1247, 1249, 1279, 1280, 4095]),
    )
    word = st.builds(lambda kind, q: kind << 12 | q, kinds, payload)
    triple = st.tuples(st.integers(0, 4095), st.integers(0, 4095), st.integers(0, 255)).map(
        lambda q: [0x4000 | q[0], 0x4000 | q[1], 0x5000 | q[2]]
    )
    complete = st.lists(st.one_of(word.map(lambda w: [w]), triple), max_size=60)
    return complete.map(lambda parts: [0x8000, *(w for part in parts for w in part)])


@settings(max_examples=300, deadline=None, derandomize=True)
@given(any_words())
def test_random_words_equal_the_oracle(words: list[int]) -> None:
    assert_same_as_oracle(words)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(any_words(), st.lists(st.integers(0, 130), max_size=12))
def test_any_split_gives_the_same(words: list[int], cuts: list[int]) -> None:
    data = np.array(words, dtype="<u2").tobytes()
    decoder, events, triggers = evt3.Decoder(), [], []
    edges = [0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]
    for start, stop in pairwise(edges):
        part = decoder.decode(data[start:stop])
        events += part.packed().tolist()
        triggers += trigger_list(part)
    assert (events, triggers, decoder.counters) == decoded(data)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(any_words(), st.lists(st.integers(0, 2000), max_size=6))
def test_passes_that_stop_before_late_events_give_the_same(
    words: list[int], stops: list[int]
) -> None:
    """As the reconstruction decodes: up to the end of a period, then on from there."""
    data = np.array(words, dtype="<u2")
    expected, triggers, counters = decoded(data.tobytes())
    t_us = sorted(expected[k % len(expected)][0] + k % 2 for k in stops if expected)
    decoder, i, events, found = evt3.Decoder(), 0, [], []
    memory = decoder.memory._replace(triggers=_trigger_arrays(data.size))
    for until_us in (*t_us, 1 << 62):
        out = event_arrays(12 * data.size)
        i, n, m = decode_stored(data, np.uint64(i), until_us, True, memory, out)
        events += list(zip(*(values[:n].tolist() for values in out), strict=True))
        found += list(zip(*(values[:m].tolist() for values in memory.triggers), strict=True))
        assert all(event[0] < until_us for event in events)
    assert (int(i), events, found) == (data.size, expected, triggers)
    assert decoder.counters == counters


@settings(max_examples=150, deadline=None, derandomize=True)
@given(st.binary(max_size=400))
def test_random_bytes_stay_inside_the_buffers(data: bytes) -> None:
    decoder, words, guard = evt3.Decoder(), len(data) // 2, 64
    buffers = tuple(
        type(arrays)(*(np.full(size + guard, 77, array.dtype) for array in arrays))
        for arrays, size in ((decoder._events, 12 * words), (decoder.memory.triggers, words))
    )
    decoder._events, decoder._memory = buffers[0], decoder.memory._replace(triggers=buffers[1])
    events = decoder.decode(data)
    for arrays, written in zip(buffers, (len(events), len(events.triggers)), strict=True):
        assert all((array[written:] == 77).all() for array in arrays)
        assert all(array.size >= written + guard for array in arrays)
    assert (events.x < 1280).all()
    assert (events.y < 720).all()
    assert (np.diff(events.t) >= 0).all()


def test_recording_like_stream() -> None:
    words = recording_like_words(np.random.default_rng(41), 3000)
    kinds = np.bincount(np.array(words) >> 12, minlength=16) / len(words)
    for kind, share in RECORDING_SHARES.items():
        assert kinds[kind] == pytest.approx(share, rel=0.35), "seed 41"
    assert_same_as_oracle(words)
    data = np.array(words, dtype="<u2")
    events = evt3.Decoder().decode(data.view(np.uint8))
    assert len(events) == 123_011
    digest = hashlib.sha256(events.packed().tobytes()).hexdigest()
    assert digest == "538d26af0852758c1916e8ec68ed8017248c233aafffbed85afe9aa5eaf5cc82"


def test_large_input_is_counted_first() -> None:
    piece = [0x002A, 0x2805, 0x3000, 0x4FFF, 0x4FFF, 0x50FF, 0xA001]
    words = np.tile(np.array(piece, "<u2"), 30_000)
    events = evt3.Decoder().decode(np.concatenate([[np.uint16(0x8000)], words]).view(np.uint8))
    assert (len(events), len(events.triggers)) == (33 * 30_000, 30_000)


@pytest.mark.skipif(
    not RECORDING.is_file(),
    reason="EVT3_RECORDING is not the path of evt3_gen41_sample.raw, test data of expelliarmus",
)
@pytest.mark.parametrize("chunk_bytes", [131_072, 4_099])
def test_real_recording(chunk_bytes: int) -> None:
    reader = RawReader(RECORDING)
    decoder = evt3.Decoder(reader.header.width, reader.header.height)
    parts = [decoder.decode(piece).packed() for piece in reader.chunks(chunk_bytes)]
    events = np.concatenate(parts)
    assert len(events) == 219_596
    assert (int(events["x"].sum()), int(events["y"].sum())) == (159_113_225, 85_638_051)
    assert int(events["p"].sum()) == 115_532
    assert (events["t"][0], events["t"][-1]) == (11_718_656, 11_727_457)
    assert int(events["t"].sum()) == 2_574_324_900_467
    digest = hashlib.sha256(events.tobytes()).hexdigest()
    assert digest == "9bba5ca48301878102200069a89413a3240eaae3ff599d217f1c1a84d13fe7ba"
    counters = decoder.counters
    assert (counters.events, counters.events_dropped, counters.triggers) == (219_596, 0, 0)


@pytest.mark.parametrize("bit", range(12))
def test_a_flipped_bit_of_a_time_word_is_forgotten_within_20_ms(bit: int) -> None:
    t_us = np.arange(2_000_000, 2_400_000, 50)
    ones = np.ones(t_us.size, np.int64)
    words = np.frombuffer(evt3.Encoder().encode(t_us, ones, ones, ones), "<u2").copy()
    highs = np.flatnonzero(words >> 12 == 8)
    words[highs[30]] ^= 1 << bit
    found = evt3.Decoder().decode(words.tobytes())
    flipped_us = int(words[highs[29]] & 0xFFF) + 1 << 12
    assert len(found) == t_us.size
    wrong = found.t != t_us
    assert not wrong[(t_us < flipped_us) | (t_us >= flipped_us + 20_000)].any()


@pytest.mark.parametrize("size", [1000, 100_000])
def test_time_outlasts_a_stretch_of_random_bytes(size: int) -> None:
    seed = 3
    print(f"seed {seed}")
    rng = np.random.default_rng(seed)
    t_us = np.arange(2_000_000, 3_000_000, 2)
    ones = np.ones(t_us.size, np.int64)
    sent = bytearray(evt3.Encoder().encode(t_us, ones, ones, ones))
    begin = len(sent) // 4
    sent[begin : begin + size] = rng.bytes(size)
    found = evt3.Decoder().decode(bytes(sent))
    # The events behind the stretch come last, and from 20 ms after it on each has its time.
    behind = t_us[t_us > t_us[-1] - 500_000]
    assert np.array_equal(found.t[-behind.size :], behind)


def test_a_copy_goes_on_while_a_jump_awaits_confirmation() -> None:
    """Whatever each has counted before."""
    before, after = words_of("8001 9000 9000 002A 8400"), words_of("8400 8401 2805")
    whole = evt3.Decoder()
    whole.decode(before)
    copy = evt3.Decoder()
    copy.go_on_from(whole)
    found = copy.decode(after)
    assert found.t.tolist() == [0x401 << 12]
    whole.add_counts(copy)
    whole.go_on_from(copy)
    assert (whole.time_us, whole.counters.unknown_words) == (0x401 << 12, 2)
    assert whole.is_at(copy)
