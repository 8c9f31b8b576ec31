"""EVT3 encoding: what goes in comes back, in as few words as the format allows."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from streams import line_row_events, sparse_events

from eschorty_ros.core import evt3
from eschorty_ros.core.base.errors import ArgumentError


def hex_words(data: bytes) -> str:
    return " ".join(f"{word:04X}" for word in np.frombuffer(data, "<u2"))


def columns_of(events: list[tuple[int, int, int, int]]) -> list[list[int]]:
    return [[event[k] for event in events] for k in range(4)]


def test_single_events_and_time_words() -> None:
    encoder = evt3.Encoder()
    data = encoder.encode([100, 100, 5000], [5, 6, 7], [42, 42, 43], [1, 0, 1])
    assert hex_words(data) == "8000 6064 002A 2805 2006 8001 6388 002B 2807"
    assert encoder.time_us == 5000


def test_vectors_where_they_pay() -> None:
    encoder = evt3.Encoder()
    four = encoder.encode([0] * 4, [10, 11, 12, 13], [1] * 4, [0] * 4)
    assert hex_words(four) == "8000 6000 0001 200A 200B 200C 200D"
    five = encoder.encode([1] * 9, [10, 11, 12, 13, 41, 42, 43, 44, 45], [1] * 9, [1] * 9)
    assert hex_words(five) == "6001 0001 380A 400F 4000 5080 400F 4000 5000"


def test_vectors_end_at_the_sensors_edge() -> None:
    data = evt3.Encoder().encode([0] * 6, range(1274, 1280), [0] * 6, [0] * 6)
    assert hex_words(data) == "8000 6000 0000 34E0 4000 4000 50FC"


def test_advance_writes_every_time_high() -> None:
    encoder = evt3.Encoder()
    assert hex_words(encoder.advance(0)) == "8000"
    assert hex_words(encoder.advance(3 * 4096 + 1)) == "8001 8002 8003 6001"
    assert encoder.advance(3 * 4096 + 1) == b""
    decoder = evt3.Decoder()
    decoder.decode(encoder.advance(200_000_000))
    assert decoder.time_us == 200_000_000


def test_idle_stops_do_not_show_once_events_come() -> None:
    stopped, straight = evt3.Encoder(), evt3.Encoder()
    data = stopped.advance(0) + stopped.advance(4096) + stopped.encode([4096], [5], [6], [1])
    assert data == straight.advance(0) + straight.encode([4096], [5], [6], [1])
    assert hex_words(data) == "8000 8001 6000 0006 2805"


def test_idle_minutes_keep_the_epoch() -> None:
    encoder, decoder = evt3.Encoder(), evt3.Decoder()
    first = encoder.encode([7], [1], [1], [1])
    later = encoder.encode([1_800_000_007], [2], [2], [0])
    assert decoder.decode(first + later).t.tolist() == [7, 1_800_000_007]
    assert decoder.counters.time_high_jumps == 0


def event_lists() -> st.SearchStrategy[tuple[list, list]]:
    step = st.sampled_from([0, 0, 0, 0, 1, 3, 4095, 4096, 70_000, 17_000_000])
    run = st.tuples(
        step,
        st.integers(0, 719),
        st.integers(0, 1),
        st.lists(st.one_of(st.integers(0, 1279), st.integers(1200, 1279)), max_size=40),
        st.booleans(),
        st.booleans(),
    )
    return st.lists(run, max_size=12).map(as_streams)


def as_streams(runs: list) -> tuple[list, list]:
    t, events, triggers = 0, [], []
    for step, y, p, xs, ordered, trigger in runs:
        t += step
        events += [(t, x, y, p) for x in (sorted(xs) if ordered else xs)]
        if trigger:
            triggers.append((t, p))
    return events, triggers


@settings(max_examples=200, deadline=None, derandomize=True)
@given(event_lists(), st.integers(0, 500), st.booleans())
def test_round_trip(streams: tuple[list, list], cut: int, idle: bool) -> None:
    events, triggers = streams
    cut = min(cut, len(events))
    encoder = evt3.Encoder()
    data = encoder.advance(0)
    border = events[cut - 1][0] if cut else 0
    early = [trigger for trigger in triggers if trigger[0] <= border]
    for part, edges in ((events[:cut], early), (events[cut:], triggers[len(early) :])):
        data += encoder.encode(*columns_of(part), [t for t, _ in edges], [p for _, p in edges])
        if idle and part and part is not events:
            data += encoder.advance(encoder.time_us)
    decoder = evt3.Decoder()
    found = decoder.decode(data)
    assert found.packed().tolist() == events
    t, edge = found.triggers.t.tolist(), found.triggers.edge.tolist()
    assert list(zip(t, edge, strict=True)) == triggers
    assert (decoder.counters.events_dropped, decoder.counters.broken_triples) == (0, 0)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (31, 20), (32, 20), (2048, 2048)])
def test_round_trip_on_any_sensor(width: int, height: int) -> None:
    x, y = (a.ravel() for a in np.meshgrid(np.arange(width), np.arange(min(height, 7))))
    events = evt3.sort_readout(np.zeros(x.size, np.int64), x, y, np.ones(x.size, np.uint8))
    data = evt3.Encoder(width, height).encode(*events)
    found = evt3.Decoder(width, height).decode(data)
    assert (found.x == events[1]).all()
    assert (found.y == events[2]).all()


def test_line_is_compact_and_noise_is_not_padded() -> None:
    rng = np.random.default_rng(7)
    line = evt3.sort_readout(*line_row_events(rng, 200_000))
    assert len(evt3.Encoder().encode(*line)) / line[0].size < 0.42
    sparse = sparse_events(rng, 100_000)
    assert len(evt3.Encoder().encode(*sparse)) / 100_000 < 4.3


def test_sort_readout_orders_by_time_row_polarity_column() -> None:
    rng = np.random.default_rng(3)
    origin = 1 << 50
    t, x, y, p = (rng.integers(0, top, 5000) for top in (40, 1280, 9, 2))
    order = np.lexsort((x, p, y, t))
    found = evt3.sort_readout(t + origin, x, y, p)
    for values, expected in zip(found, (t + origin, x, y, p), strict=True):
        assert (values == expected[order]).all()


def test_reports_of_the_rate_control_come_complete_before_the_events_of_their_time() -> None:
    reports = [[200, 0x7456123, 5], [400, 12, 12], [9000, 7, 0]]
    data = evt3.Encoder().encode(
        [150, 200, 8000], [1, 2, 3], [4, 4, 4], [1, 1, 1],
        trigger_t=[200, 300], trigger_edge=[1, 0], drop_t=[200], rate_counts=reports,
    )  # fmt: skip
    words = [f"{word:04X}" for word in np.frombuffer(data, "<u2")]
    begin = words.index("60C8") + 1
    assert words[begin : begin + 2] == ["A001", "EEDA"]
    expected = ["E014", "F123", "F456", "7007", "E016", "F005", "F000", "7000"]
    assert words[begin + 2 : begin + 10] == expected
    decoder = evt3.Decoder()
    events = decoder.decode(data)
    assert events.t.tolist() == [150, 200, 8000]
    assert events.triggers.t.tolist() == [200, 300]
    counters = decoder.counters
    assert (counters.erc_events_in, counters.erc_events_out) == (0x7456123 + 19, 17)
    assert (counters.broken_continuations, counters.sensor_dropped_events) == (0, 1)


@pytest.mark.parametrize(
    ("events", "message"),
    [
        (([5, 4], [0, 0], [0, 0], [0, 0]), r"t\[1\] is 4 us"),
        (([0, 1], [0], [0], [0]), "entries"),
        (([0, 4_000_000_000], [0, 0], [0, 0], [0, 0]), "stay within"),
        (([], [], [], [], [3], []), "one edge per trigger"),
        (([], [], [], [], [], [], [], [[5, 1, 1], [4, 1, 1]]), r"rate_counts\[1\] is 4 us"),
    ],
)
def test_bad_events_are_refused(events: tuple, message: str) -> None:
    with pytest.raises(ArgumentError, match=message):
        evt3.Encoder().encode(*events)


def test_time_never_goes_back_between_calls() -> None:
    encoder = evt3.Encoder()
    encoder.advance(100)
    with pytest.raises(ArgumentError, match="after 100 us"):
        encoder.encode([99], [0], [0], [0])
    with pytest.raises(ArgumentError, match="t_us"):
        encoder.advance(50)
