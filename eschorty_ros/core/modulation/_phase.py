"""Compiled schedule of rising edges: prediction, trigger re-anchoring, bridging."""

from __future__ import annotations

from eschorty_ros.core.base.kernel import kernel

# Predicted edges without a trigger before any trigger is taken as the new phase.
MISSED_MAX = 3
TOLERANCE_SHARE = 4

S_ANCHOR, S_STEP, S_WHOLE, S_REST, S_INDEX, S_LAST, S_TRIGGERED, S_MISSED, S_SIZE = range(9)
COUNTERS = ("triggers_used", "triggers_spurious", "edges_bridged", "phase_locks")
C_USED, C_SPURIOUS, C_BRIDGED, C_LOCKS = range(len(COUNTERS))


@kernel
def _rounded(whole, rest, denominator):
    """``whole + rest / denominator`` to the nearest integer, half to even."""
    twice = 2 * rest
    if twice > denominator or (twice == denominator and whole & 1):
        return whole + 1
    return whole


@kernel
def _schedule(state, step, part, denominator, every, triggers, first, watermark, edges, indices, c):
    """Edges that are certain once everything before ``watermark`` is known.

    Returns the number of edges written, the first trigger not used, and the time before which
    events may be assigned.
    """
    tolerance = max((step + 1) // TOLERANCE_SHARE, 1)
    n = 0
    trigger = first
    while True:
        whole = state[S_WHOLE] + step
        rest = state[S_REST] + part
        if rest >= denominator:
            rest -= denominator
            whole += 1
        predicted = state[S_ANCHOR] + _rounded(whole, rest, denominator)
        if n == edges.size:
            return n, trigger, min(watermark, state[S_LAST])
        locked = state[S_TRIGGERED] != 0 and state[S_MISSED] < MISSED_MAX
        deadline = predicted + tolerance if state[S_TRIGGERED] != 0 else predicted
        if trigger < triggers.size and triggers[trigger] <= deadline:
            t = triggers[trigger]
            trigger += 1
            if locked and t < predicted - tolerance:
                c[C_SPURIOUS] += 1
                continue
            if not locked:
                c[C_LOCKS] += 1
            c[C_USED] += 1
            state[S_TRIGGERED] = 1
            state[S_MISSED] = 0
            state[S_ANCHOR] = t
            state[S_STEP] = 0
            state[S_WHOLE] = 0
            state[S_REST] = 0
            if not locked and t - state[S_LAST] < tolerance:
                # The edge just predicted was this one: later edges count from the trigger.
                continue
            edge = t
        elif deadline < watermark:
            state[S_STEP] += 1
            state[S_WHOLE] = whole
            state[S_REST] = rest
            if state[S_TRIGGERED] != 0:
                state[S_MISSED] += 1
                c[C_BRIDGED] += 1
            edge = predicted
        else:
            return n, trigger, min(watermark, predicted)
        state[S_INDEX] += 1
        state[S_LAST] = edge
        if state[S_INDEX] % every == 0:
            edges[n] = edge
            indices[n] = state[S_INDEX]
            n += 1
