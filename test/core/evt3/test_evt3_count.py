"""Counting words agrees with decoding them."""

import numpy as np

from eschorty_ros.core.evt3 import Decoder, WordCounter


def words(*values: int) -> bytes:
    return np.array(values, "<u2").tobytes()


def test_events_of_every_kind() -> None:
    counter = WordCounter()
    counter.add(words(0x8001, 0x6000, 0x0005, 0x2803, 0x2004))
    counter.add(words(0x3810, 0x4FFF, 0x4001, 0x5103))
    counter.add(words(0x3000, 0x5080, 0xA001, 0xEED6, 0xEEDA, 0xE014, 0xEED8))
    assert (counter.on, counter.off) == (1 + 12 + 1 + 2, 1 + 1)
    assert (counter.triggers, counter.drop_words) == (1, 3)


def test_cuts_between_buffers_do_not_matter() -> None:
    generator = np.random.default_rng(20)
    kinds = generator.choice([0x0, 0x2, 0x3, 0x4, 0x5, 0x6], 5000)
    payload = generator.integers(0, 0x1000, 5000)
    # Rows and columns inside the sensor, so that a decoder takes every event.
    payload[kinds == 0x0] &= 0x1FF
    payload[kinds == 0x2] &= 0xBFF
    payload[kinds == 0x3] &= 0x8FF
    data = words(0x8001, 0x6000, 0x0005, 0x3000, *(kinds << 12 | payload).tolist())
    uncut, cut = WordCounter(), WordCounter()
    uncut.add(data)
    for start in range(0, len(data), 14):
        cut.add(data[start : start + 14])
    assert (uncut.on, uncut.off) == (cut.on, cut.off)
    decoder = Decoder()
    events = decoder.decode(data)
    print(f"seed 20: {len(events)} events, {decoder.counters}")
    assert np.count_nonzero(events.p) == uncut.on
    assert len(events) == uncut.on + uncut.off


def test_counts_of_the_rate_control_agree_with_the_decoder() -> None:
    data = words(
        0x8000, 0xE014, 0xF123, 0xF456, 0x7007, 0xE016, 0xF005, 0xF000, 0x7000,
        0xE015, 0xFFFF, 0xFFFF, 0x700F,  # another subtype's
        0xE014, 0xF005, 0xEEDA, 0xF0FF, 0xF000, 0x7000,  # cut short
        0xE016, 0xF001, 0xF001, 0xF001, 0x7001,  # one too many
    )  # fmt: skip
    decoder = Decoder()
    decoder.decode(data)
    for size in (2, 6, len(data)):
        counter = WordCounter()
        for start in range(0, len(data), size):
            counter.add(data[start : start + size])
        assert counter.erc_events_in == decoder.counters.erc_events_in == 0x7456123 + 5
        assert counter.erc_events_out == decoder.counters.erc_events_out == 5 + 0x1001
        assert counter.drop_words == 1
