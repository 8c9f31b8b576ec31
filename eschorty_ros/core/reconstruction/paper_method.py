"""The paper's processing in plain numpy, for comparison.

Nothing is compiled, from the bytes on. Per window: accumulate all events in a frame of columns by
rows, take each column's mean row as the line and its standard deviation as the confidence, and
turn rows into ranges with Eq. 2. No phase gate, no outlier rejection, no streaming: background
anywhere in a column biases its mean.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eschorty_ros.core.base.arrays import byte_view, integer_vector, ordered_times
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.evt3 import words as w3
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import RangeModel
from eschorty_ros.core.reconstruction.profiles import LineRows, Profiles

# Columns with fewer events give no point.
_EVENTS_MIN = 4


def decode_all(data: bytes) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return times (us), columns and rows of a complete, well-formed EVT3 stream.

    Each word's time, row and vector base come from the latest word of the kind that sets them.
    No checks, no triggers: streams that are not well-formed need ``evt3.Decoder``.
    """
    view = byte_view("data", data)
    words = np.frombuffer(view, dtype="<u2", count=len(view) // 2)
    kind, payload = words >> 12, (words & 0xFFF).astype(np.int64)
    index = np.arange(words.size)

    def latest(marked: NDArray[np.bool_]) -> NDArray[np.int64]:
        return np.maximum.accumulate(np.where(marked, index, -1))

    high_at = np.flatnonzero(kind == w3.TIME_HIGH)
    high = payload[high_at]
    step = np.diff(high, prepend=high[:1])
    unwrapped = high + 4096 * np.cumsum(step < -2048)
    changed = np.zeros(words.size, bool)
    changed[high_at[(step != 0) | (high_at == high_at[:1])]] = True
    time_high = np.zeros(words.size, np.int64)
    time_high[high_at] = unwrapped
    last_low = latest(kind == w3.TIME_LOW)
    low = np.where(last_low > latest(changed), payload[last_low], 0)

    pixels = np.select([kind == w3.VECT_12, kind == w3.VECT_8], [12, 8], 0)
    before = np.cumsum(pixels) - pixels
    base_at = latest(kind == w3.VECT_BASE_X)
    base = (payload[base_at] & 0x7FF) + before - before[base_at]
    mask = np.select(
        [kind == w3.ADDR_X, kind == w3.VECT_12, kind == w3.VECT_8],
        [np.int64(1), payload, payload & 0xFF],
        0,
    )
    mask[: high_at[0] if high_at.size else words.size] = 0
    senders = np.flatnonzero(mask)
    which, bit = np.nonzero(mask[senders, None] >> np.arange(12) & 1)
    sender = senders[which]
    t_us = (time_high[latest(kind == w3.TIME_HIGH)[sender]] << 12) + low[sender]
    column = np.where(kind[sender] == w3.ADDR_X, payload[sender] & 0x7FF, base[sender] + bit)
    row = payload[latest(kind == w3.ADDR_Y)[sender]] & 0x7FF
    return t_us, column, row


def reconstruct(
    t_us: ArrayLike, column: ArrayLike, row: ArrayLike, model: RangeModel, modulation: Modulation
) -> Profiles:
    """Return the column means of every modulation period.

    ``sigma_row`` is the plain standard deviation of the column, as in the paper.

    - ``t_us``: int64 of shape (n,), never falling.
    - ``column``, ``row``: Integers of shape (n,), inside the sensor of ``model``.
    - ``modulation``: ``on_edge_us`` gives the periods' phase; the first event's time when it is
      ``None``.

    Raises ``ArgumentError`` when the three arrays differ in length, times fall or a pixel is off
    the sensor.
    """
    t = ordered_times("t_us", t_us)
    x = integer_vector("column", column, np.int64, 0, model.columns - 1)
    y = integer_vector("row", row, np.int64, 0, model.rows - 1)
    if not t.shape == x.shape == y.shape:
        raise ArgumentError(
            f"t_us, column and row have {t.size}, {x.size} and {y.size} entries; give equal numbers"
        )
    if t.size == 0:
        return Profiles.empty()
    origin = int(t[0]) if modulation.on_edge_us is None else modulation.on_edge_us
    anchored = Modulation(modulation.frequency_hz, modulation.duty, modulation.waveform, origin)
    first = int((int(t[0]) - origin) // modulation.period_us)
    last = int((int(t[-1]) - origin) // modulation.period_us) + 1
    edges = np.array([anchored.edge_us(k) for k in range(first, last + 1)], dtype=np.int64)
    cuts = np.searchsorted(t, edges)
    windows = [
        _window(t[a:b], x[a:b], y[a:b], model, first + k, int(edges[k]))
        for k, (a, b) in enumerate(pairwise(cuts))
        if b > a
    ]
    return Profiles.concatenate(windows)


def _window(
    t_us: NDArray[np.int64],
    x: NDArray[np.integer],
    y: NDArray[np.integer],
    model: RangeModel,
    period: int,
    edge_us: int,
) -> Profiles:
    size = model.columns * model.rows
    address = x.astype(np.int64) * model.rows + y
    frame = np.bincount(address, minlength=size).reshape(model.columns, model.rows)
    count = frame.sum(axis=1)
    lit = np.flatnonzero(count >= _EVENTS_MIN)
    n = count[lit]
    seen = frame[lit].astype(np.float64)
    rows = np.arange(model.rows, dtype=np.float64)
    mean = seen @ rows / n
    variance = np.einsum("cr,cr->c", seen, (rows - mean[:, None]) ** 2) / n
    mean_dt = np.bincount(x, weights=t_us - edge_us, minlength=model.columns)[lit] / n
    sigma = np.sqrt(variance)
    rows_found = LineRows(
        period=np.full(lit.size, period, dtype=np.int64),
        edge_us=np.full(lit.size, edge_us, dtype=np.int64),
        t_us=edge_us + np.rint(mean_dt).astype(np.int64),
        column=lit.astype(np.uint16),
        row=mean,
        sigma_row=sigma,
        events=n.astype(np.uint32),
        width_px=sigma * np.sqrt(n / np.maximum(n - 1.0, 1.0)),
        return_index=np.zeros(lit.size, dtype=np.uint8),
        flags=np.zeros(lit.size, dtype=np.uint16),
    )
    return Profiles.from_rows(rows_found, model)
