"""Words, gaps, restarts and failures in the queue between receiving and publishing."""

from __future__ import annotations

import pytest

from eschorty_ros.core.base.errors import DeviceGoneError
from eschorty_ros.hardware.camera.chunk_queue import ChunkQueue


def opened() -> ChunkQueue:
    queue = ChunkQueue()
    queue.open()
    return queue


def test_words_cut_by_a_transfer_are_joined() -> None:
    queue = opened()
    queue.put(b"abc", 1)
    queue.put(b"d", 2)
    queue.put(b"e", 3)
    queue.put(b"f", 4)
    got = [queue.get(0.0), queue.get(0.0), queue.get(0.0)]
    assert [chunk.data for chunk in got if chunk] == [b"ab", b"cd", b"ef"]


def test_a_gap_discards_half_a_word() -> None:
    queue = opened()
    queue.put(b"abc", 1)
    queue.mark_gap()
    queue.put(b"xy", 2)
    got = [queue.get(0.0), queue.get(0.0)]
    assert [(chunk.data, chunk.gap) for chunk in got if chunk] == [(b"ab", False), (b"xy", True)]


def test_a_restart_is_marked_once_and_replaces_the_gap_before_it() -> None:
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
