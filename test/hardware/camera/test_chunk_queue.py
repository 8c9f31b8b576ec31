"""The queue between receiving and publishing: nothing lost silently."""

from __future__ import annotations

import pytest

from eschorty_ros.core.base.errors import DeviceGoneError
from eschorty_ros.hardware.camera.chunk_queue import ChunkQueue


def opened(bytes_max: int = 1000) -> ChunkQueue:
    queue = ChunkQueue(bytes_max)
    queue.open()
    return queue


def test_first_chunk_begins_the_stream() -> None:
    queue = opened()
    queue.put(b"abcd", 7)
    queue.put(b"efgh", 8)
    first, second = queue.get(0.0), queue.get(0.0)
    assert first is not None
    assert second is not None
    assert (first.data, first.arrival_ns, first.restarted, first.gap) == (b"abcd", 7, True, False)
    assert (second.data, second.restarted) == (b"efgh", False)
    assert queue.get(0.0) is None


def test_words_cut_by_a_transfer_are_joined() -> None:
    queue = opened()
    queue.put(b"abc", 1)
    queue.put(b"d", 2)
    queue.put(b"e", 3)
    queue.put(b"f", 4)
    got = [queue.get(0.0), queue.get(0.0), queue.get(0.0)]
    assert [chunk.data for chunk in got if chunk] == [b"ab", b"cd", b"ef"]


def test_overflow_drops_counts_and_marks_the_gap() -> None:
    queue = opened(bytes_max=8)
    queue.put(b"aaaa", 1)
    queue.put(b"bbbb", 2)
    queue.put(b"cccc", 3)
    queue.put(b"dddd", 4)
    assert (queue.drops, queue.dropped_bytes, queue.gaps) == (2, 8, 1)
    assert [queue.get(0.0).gap for _ in range(2)] == [False, False]  # type: ignore[union-attr]
    queue.put(b"eeee", 5)
    late = queue.get(0.0)
    assert late is not None
    assert (late.data, late.gap) == (b"eeee", True)
    assert queue.received_bytes == 20


def test_gap_forgets_half_a_word() -> None:
    queue = opened()
    queue.put(b"abc", 1)
    queue.mark_gap()
    queue.put(b"xy", 2)
    got = [queue.get(0.0), queue.get(0.0)]
    assert [(chunk.data, chunk.gap) for chunk in got if chunk] == [(b"ab", False), (b"xy", True)]


def test_restart_is_marked_once_and_swallows_the_gap_before_it() -> None:
    queue = opened()
    queue.put(b"ab", 1)
    queue.mark_gap()
    queue.mark_restart()
    queue.put(b"cd", 2)
    queue.put(b"ef", 3)
    got = [queue.get(0.0) for _ in range(3)]
    assert [(c.restarted, c.gap) for c in got if c] == [
        (True, False),
        (True, False),
        (False, False),
    ]
    assert queue.restarts == 2


def test_failure_comes_after_the_last_chunk() -> None:
    queue = opened()
    queue.put(b"ab", 1)
    queue.fail(DeviceGoneError("gone"))
    assert queue.get(0.0) is not None
    with pytest.raises(DeviceGoneError, match="gone"):
        queue.get(10.0)
    queue.open()
    assert queue.get(0.0) is None


def test_close_wakes_the_reader() -> None:
    queue = opened()
    queue.close()
    assert queue.get(10.0) is None
