"""Words, gaps, restarts and failures in the queue between receiving and publishing."""

import pytest

from eschorty_ros.core.base.errors import DeviceGoneError
from eschorty_ros.hardware.camera.chunk_queue import ChunkQueue


@pytest.fixture
def queue() -> ChunkQueue:
    queue = ChunkQueue()
    queue.open()
    return queue


def test_words_cut_by_a_transfer_are_joined(queue: ChunkQueue) -> None:
    for at, data in enumerate((b"abc", b"d", b"e", b"f")):
        queue.put(data, at)
    assert [queue.get(0.0).data for _ in range(3)] == [b"ab", b"cd", b"ef"]


def test_a_gap_discards_half_a_word(queue: ChunkQueue) -> None:
    queue.put(b"abc", 1)
    queue.mark_gap()
    queue.put(b"xy", 2)
    got = [queue.get(0.0) for _ in range(2)]
    assert [(chunk.data, chunk.gap) for chunk in got] == [(b"ab", False), (b"xy", True)]


def test_a_restart_is_marked_once_and_replaces_the_gap_before_it(queue: ChunkQueue) -> None:
    queue.put(b"ab", 1)
    queue.mark_gap()
    queue.mark_restart()
    queue.put(b"cd", 2)
    queue.put(b"ef", 3)
    got = [queue.get(0.0) for _ in range(3)]
    assert not any(chunk.gap for chunk in got)
    assert [chunk.restarted for chunk in got] == [True, True, False]
    assert queue.restarts == 2


def test_failure_comes_after_the_last_chunk(queue: ChunkQueue) -> None:
    queue.put(b"ab", 1)
    queue.fail(DeviceGoneError("gone"))
    assert queue.get(0.0) is not None
    with pytest.raises(DeviceGoneError, match="gone"):
        queue.get(10.0)
    queue.open()
    assert queue.get(0.0) is None
