"""The row arbiter and the event-rate control behind it; see ``readout``."""

from __future__ import annotations

from eschorty_ros.core.base.kernel import kernel

# State: time at which the arbiter is free (ns), rows in the queue, place of the first of them,
# events waiting, period of the rate control (-1 for none begun), events that came to it and that
# it let through in this period, periods told in this call, events dropped by the control, events
# dropped by the arbiter, last time span in which such a drop was told, drops told in this call.
(
    S_FREE,
    S_QUEUED,
    S_FIRST,
    S_WAITING,
    S_PERIOD,
    S_CAME,
    S_PASSED,
    S_PERIODS,
    S_CUT,
    S_DROPPED,
    S_TOLD,
    S_NOTES,
) = range(12)
S_SIZE = 12


@kernel
def _drop(t_us, note_us, state, drops):
    """Count an event that the arbiter has no room for; the first of a time span is told."""
    state[S_DROPPED] += 1
    if state[S_TOLD] != t_us // note_us:
        state[S_TOLD] = t_us // note_us
        drops[state[S_NOTES]] = t_us
        state[S_NOTES] += 1


@kernel
def _end_period(period_us, state, periods):
    """Tell what came and what passed in the period of the rate control that ends."""
    if state[S_CAME] > 0:
        k = state[S_PERIODS]
        periods[k, 0] = (state[S_PERIOD] + 1) * period_us
        periods[k, 1], periods[k, 2] = state[S_CAME], state[S_PASSED]
        state[S_PERIODS] += 1
    state[S_CAME], state[S_PASSED], state[S_PERIOD] = 0, 0, -1


@kernel
def _serve(
    until_us, row_ns, period_us, events_max, state, queue, heads, links, keys, out, periods, n
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
        if period_us > 0 and t_us // period_us != state[S_PERIOD]:
            _end_period(period_us, state, periods)
            state[S_PERIOD] = t_us // period_us
        event = heads[row]
        heads[row] = -1
        while event >= 0:
            state[S_WAITING] -= 1
            state[S_CAME] += 1
            if period_us == 0 or state[S_PASSED] < events_max:
                out[n] = (t_us << 22) | (keys[event] & 0x3FFFFF)
                n += 1
                state[S_PASSED] += 1
            else:
                state[S_CUT] += 1
            # Free places form a chain of their own, behind the rows.
            following = links[event]
            links[event] = heads[heads.size - 1]
            heads[heads.size - 1] = event
            event = following
    return n


@kernel
def _read_out(
    requests, until_us, row_ns, period_us, events_max, note_us, state, queue, heads, links, keys,
    out, drops, periods,
):  # fmt: skip
    """Pass sorted requests through the arbiter; returns the events in ``out``.

    A ``period_us`` of 0 is no rate control. ``drops`` gets the time of the arbiter's first drop
    of every ``note_us``, ``S_NOTES`` of them; ``periods`` the end of every period of the rate
    control with events, what came and what passed, ``S_PERIODS`` of them.
    """
    n = 0
    state[S_NOTES] = 0
    state[S_PERIODS] = 0
    served_us = -1
    for request in requests:
        t_us = request >> 22
        if t_us != served_us:
            served_us = t_us
            n = _serve(
                t_us,
                row_ns,
                period_us,
                events_max,
                state,
                queue,
                heads,
                links,
                keys,
                out,
                periods,
                n,
            )
        place = heads[heads.size - 1]
        if place < 0:
            _drop(t_us, note_us, state, drops)
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
    n = _serve(
        until_us, row_ns, period_us, events_max, state, queue, heads, links, keys, out, periods, n
    )
    if period_us > 0 and state[S_PERIOD] >= 0 and (state[S_PERIOD] + 1) * period_us < until_us:
        _end_period(period_us, state, periods)
    return n
