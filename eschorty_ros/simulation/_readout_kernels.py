"""The row arbiter; see ``readout``."""

from __future__ import annotations

from numba import njit

# State: time at which the arbiter is free (ns), rows in the queue, place of the first of them,
# events waiting, window of the rate limit, events read out in it, events dropped, last window
# in which a drop was told, drops told in this call.
S_FREE, S_QUEUED, S_FIRST, S_WAITING, S_WINDOW, S_READ, S_DROPPED, S_TOLD, S_NOTES = range(9)
S_SIZE = 9


@njit(cache=True, nogil=True)
def _drop(t_us, window_us, state, drops):
    """Count a lost event; the first of a window is told."""
    state[S_DROPPED] += 1
    if state[S_TOLD] != t_us // window_us:
        state[S_TOLD] = t_us // window_us
        drops[state[S_NOTES]] = t_us
        state[S_NOTES] += 1


@njit(cache=True, nogil=True)
def _serve(
    until_us, row_ns, window_us, window_events, state, queue, heads, links, keys, out, drops, n
):
    """Read out rows as long as one is due before ``until_us``; returns the events in ``out``.

    ``queue`` holds rows and the time each was asked for, ``heads`` per row its last event and
    ``links`` per event the one before; -1 ends a chain.
    """
    capacity = queue.shape[0]
    while state[S_QUEUED] > 0:
        row, asked_us = queue[state[S_FIRST], 0], queue[state[S_FIRST], 1]
        begin_ns = max(state[S_FREE], asked_us * 1000)
        t_us = -(-begin_ns // 1000)
        if t_us >= until_us:
            break
        state[S_FIRST] = (state[S_FIRST] + 1) % capacity
        state[S_QUEUED] -= 1
        state[S_FREE] = begin_ns + row_ns
        if t_us // window_us != state[S_WINDOW]:
            state[S_WINDOW], state[S_READ] = t_us // window_us, 0
        event = heads[row]
        heads[row] = -1
        while event >= 0:
            state[S_WAITING] -= 1
            if state[S_READ] < window_events:
                out[n] = (t_us << 22) | (keys[event] & 0x3FFFFF)
                n += 1
                state[S_READ] += 1
            else:
                _drop(t_us, window_us, state, drops)
            # Free places form a chain of their own, behind the rows.
            following = links[event]
            links[event] = heads[heads.size - 1]
            heads[heads.size - 1] = event
            event = following
    return n


@njit(cache=True, nogil=True)
def _read_out(
    requests, until_us, row_ns, window_us, window_events, state, queue, heads, links, keys, out,
    drops,
):  # fmt: skip
    """Pass sorted requests through the arbiter; returns the events in ``out``.

    ``drops`` gets the time of the first drop of every window with one, ``S_NOTES`` of them.
    """
    n = 0
    state[S_NOTES] = 0
    served_us = -1
    for request in requests:
        t_us = request >> 22
        if t_us != served_us:
            served_us = t_us
            n = _serve(
                t_us,
                row_ns,
                window_us,
                window_events,
                state,
                queue,
                heads,
                links,
                keys,
                out,
                drops,
                n,
            )
        place = heads[heads.size - 1]
        if place < 0:
            _drop(t_us, window_us, state, drops)
            continue
        heads[heads.size - 1] = links[place]
        row = (request >> 12) & 0x3FF
        if heads[row] < 0:
            at = (state[S_FIRST] + state[S_QUEUED]) % queue.shape[0]
            queue[at, 0], queue[at, 1] = row, t_us
            state[S_QUEUED] += 1
        keys[place] = request
        links[place] = heads[row]
        heads[row] = place
        state[S_WAITING] += 1
    return _serve(
        until_us, row_ns, window_us, window_events, state, queue, heads, links, keys, out, drops, n
    )
