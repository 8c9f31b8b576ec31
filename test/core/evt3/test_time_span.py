"""A piece of a stream by its time words: when it begins and how long it lasts."""

import numpy as np
import pytest

from eschorty_ros.core.evt3 import (
    BeginTime,
    Decoder,
    Encoder,
    begin_time,
    first_time_high_us,
    time_span_us,
)


def words(*values: int) -> bytes:
    return np.array(values, "<u2").tobytes()


def stream(t_us: np.ndarray) -> bytes:
    """Return a stream with one event at each of these times."""
    column = np.arange(t_us.size) % 1280
    return Encoder().encode(t_us, column, np.full(t_us.size, 300), np.ones(t_us.size, int))


def test_first_time_high():
    assert first_time_high_us(words(0x0001, 0x8003, 0x8004)) == 3 << 12
    assert first_time_high_us(b"\x01") is None


@pytest.mark.parametrize("begin_us", [0, 5_000, (1 << 24) - 30_000])
def test_a_stream_begins_and_lasts_as_its_decoder_finds(begin_us: int) -> None:
    t_us = begin_us + np.sort(np.random.default_rng(6).integers(0, 100_000, 3_000))
    data = stream(t_us)
    high, low = begin_time(data)
    assert (high << 12) + low == t_us[0] % (1 << 24)
    decoded_us = Decoder().decode(data).t
    assert time_span_us(data) == (decoded_us[-1] >> 12) - (decoded_us[0] >> 12) << 12


@pytest.mark.parametrize(
    ("data", "begin", "span_us"),
    [
        (b"", BeginTime(-1, -1), 0),
        (words(0x0001, 0x2001), BeginTime(-1, -1), 0),
        (words(0x0001, 0x6010, 0x8004, 0x8006), BeginTime(-1, 0x10), 2 << 12),
        (words(0x8003, 0x8004, 0x6010, 0x8005), BeginTime(4, 0x10), 2 << 12),
        (words(0x8003, 0x2001), BeginTime(3, -1), 0),
        # Across the wrap, and a step back.
        (words(0x8FFF, 0x8001), BeginTime(1, -1), 2 << 12),
        (words(0x8005, 0x8004), BeginTime(4, -1), 0xFFF << 12),
    ],
)
def test_time_words(data: bytes, begin: BeginTime, span_us: int) -> None:
    assert begin_time(data) == begin
    assert time_span_us(data) == span_us
    # Wherever the bytes lie, and with half a word behind them.
    moved = memoryview(b"x" + data + b"y")[1:]
    assert begin_time(moved) == begin
    assert time_span_us(moved) == span_us


@pytest.mark.parametrize("others", range(0, 200, 7))
def test_no_time_word_is_missed_among_others(others: int) -> None:
    data = words(0x8001, *[0x2001] * others, 0x8003, *[0x2001] * 70, 0x8004)
    assert time_span_us(data) == 3 << 12
