"""Event streams and their files."""

from __future__ import annotations

from functools import partial
from typing import Any

from eschorty_ros.core.evt3 import activity_filter as noise
from eschorty_ros.core import evt3
from eschorty_ros.core.evt3 import word_count as evt3_count
from eschorty_ros.core.modulation import modulation
from eschorty_ros.core.reconstruction import reconstructor, settings
from eschorty_ros.core.storage import raw_file
from hostile.kinds import (
    Call,
    Kind,
    integers,
    octets,
    path,
    whole,
)
from hostile.subjects import (
    CALIBRATION,
    EVENT_KINDS,
    EVENTS,
    LASER,
    PATH_ONLY,
    POLARITY,
    SIGNS,
    SIZE,
    T_MAX,
    TIMES,
    N,
    method,
)


def events_with(**changed: Any) -> evt3.Events:
    none = evt3.Triggers(TIMES[:0], SIGNS[:0], SIGNS[:0])
    return evt3.Events(**{**EVENTS, **changed}, triggers=none)


def raw_writer(path: Any = "events.raw", **arguments: Any) -> None:
    raw_file.RawWriter(path, **arguments).close()


def raw_write(data: Any) -> None:
    with raw_file.RawWriter("events.raw") as writer:
        writer.write(data)


def raw_chunks(size: Any) -> bytes:
    raw_writer()
    return b"".join(raw_file.RawReader("events.raw").chunks(size))


CALLS: dict[str, Call] = {
    "evt3.Encoder": Call(evt3.Encoder, {"width": 64, "height": 64}, SIZE),
    "evt3.Encoder.encode": Call(
        method(evt3.Encoder, "encode"),
        dict(EVENTS, trigger_t=[1], trigger_edge=[1], drop_t=[1], rate_counts=[[1, 2, 1]]),
        {
            "t": integers(-1, T_MAX, size=N),
            "x": integers(-1, 1280, 65535, size=N),
            "y": integers(-1, 720, 65535, size=N),
            "p": POLARITY,
            "trigger_t": integers(-1, T_MAX, size=1),
            "trigger_edge": integers(-1, 2, size=1),
            "drop_t": Kind([bad for bad in integers(-1, T_MAX).refused if bad is not None]),
            "rate_counts": Kind(
                [[1, 2, 1], [[1, 2]], [[1.5, 2, 1]], [[-1, 2, 1]], [[1, 1 << 28, 1]], "abc"]
            ),
        },
    ),
    "evt3.Encoder.advance": Call(
        method(evt3.Encoder, "advance"), {"t_us": 5}, {"t_us": whole(-1, T_MAX)}
    ),
    "evt3.sort_readout": Call(
        evt3.sort_readout,
        EVENTS,
        {
            "t": integers(-1, T_MAX, size=N),
            "x": integers(-1, 2048, size=N),
            "y": integers(-1, 2048, size=N),
            "p": POLARITY,
        },
    ),
    "evt3.Events.packed": Call(events_with().packed, {}),
    "evt3.Decoder": Call(evt3.Decoder, {"width": 64, "height": 64}, SIZE),
    "evt3.Decoder.reset": Call(method(evt3.Decoder, "reset"), {}),
    "evt3.Decoder.note_gap": Call(method(evt3.Decoder, "note_gap"), {}),
    "evt3.Decoder.decode": Call(
        method(evt3.Decoder, "decode"), {"data": b"\x00\x80"}, {"data": octets()}
    ),
    "evt3_count.WordCounter": Call(evt3_count.WordCounter, {}),
    "evt3_count.WordCounter.add": Call(
        method(evt3_count.WordCounter, "add"), {"data": b"\x00\x80"}, {"data": octets()}
    ),
    "evt3.event_arrays": Call(evt3.event_arrays, {"size": 3}, {"size": whole(-1, 1 << 40)}),
    "noise.ActivityFilter": Call(
        noise.ActivityFilter,
        {"width": 64, "height": 64, "window_us": 5},
        dict(SIZE, window_us=whole(0, 1_000_001)),
    ),
    "noise.ActivityFilter.reset": Call(method(noise.ActivityFilter, "reset"), {}),
    "noise.ActivityFilter.filter": Call(
        lambda **changed: noise.ActivityFilter().filter(events_with(**changed)),
        EVENTS,
        EVENT_KINDS,
    ),
    "raw_file.RawReader": Call(
        lambda path: (raw_writer(), raw_file.RawReader(path)), {"path": "events.raw"}, PATH_ONLY
    ),
    "raw_file.RawReader.chunks": Call(raw_chunks, {"size": 5}, {"size": whole(0)}),
    "raw_file.RawWriter": Call(
        raw_writer,
        {
            "path": "events.raw",
            "serial": "00000000",
            "width": 64,
            "height": 64,
            "sensor_name": "IMX636",
        },
        dict(
            SIZE,
            path=path(),
            serial=Kind([None, 3, "xyz", ""]),
            sensor_name=Kind([None, 3, "two words", "", "ü"]),
        ),
    ),
    "raw_file.RawWriter.write": Call(raw_write, {"data": b"abc"}, {"data": octets()}),
    "raw_file.RawWriter.close": Call(raw_writer, {}),
    "reconstructor.Reconstructor": Call(
        reconstructor.Reconstructor,
        {"calibration": CALIBRATION, "modulation": LASER, "settings": settings.Settings()},
    ),
    "reconstructor.Reconstructor.push": Call(
        method(partial(reconstructor.Reconstructor, CALIBRATION, LASER), "push"),
        {"data": b"\x00\x80"},
        {"data": octets()},
    ),
    "reconstructor.Reconstructor.flush": Call(
        method(partial(reconstructor.Reconstructor, CALIBRATION, LASER), "flush"), {}
    ),
    "reconstructor.Reconstructor.take_stage_edges": Call(
        method(partial(reconstructor.Reconstructor, CALIBRATION, LASER), "take_stage_edges"), {}
    ),
    "reconstructor.Reconstructor.restart_phase": Call(
        method(partial(reconstructor.Reconstructor, CALIBRATION, LASER), "restart_phase"), {}
    ),
    "reconstructor.Reconstructor.note_gap": Call(
        method(partial(reconstructor.Reconstructor, CALIBRATION, LASER), "note_gap"), {}
    ),
    "reconstructor.Reconstructor.set_modulation": Call(
        method(partial(reconstructor.Reconstructor, CALIBRATION, LASER), "set_modulation"),
        {"modulation": modulation.Modulation(80.0)},
    ),
}
