"""Phase gate: an event is kept only in the part of the period in which its polarity follows light.

ON events follow rising edges of the laser and OFF events falling ones; background is spread evenly.
The gate keeps a share of (LEAD_US + gate) / period of the background of both polarities, 8 % at
70 Hz with 1 ms.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from eschorty_ros.core.base.kernel import kernel
from eschorty_ros.core.base.numbers import integer
from eschorty_ros.core.modulation.modulation import Modulation

LEAD_US = 200
"""Time from opening to edge: an estimated edge is later than the first events."""

GATE_MAX_US = 100_000
GATE_LEARNED = -1
"""In place of a time: the gate is learned from the stream."""
TURN = 1 << 32


class PhaseGate(NamedTuple):
    """Parts of the period in which ON and OFF events are kept, 2**32 per turn, as uint32."""

    step: int = 0
    """Turns per microsecond; 0 is no gate."""
    on_begin: int = 0
    on_span: int = TURN - 1
    off_begin: int = 0
    off_span: int = TURN - 1
    """Phase after the rising edge from which events are kept, and for how long."""
    keeps_late: int = 0
    """1 where other events are kept apart, 0 where they are dropped."""


def phase_gate(modulation: Modulation, gate_us: int) -> PhaseGate:
    """Return the gate after the edges of ``modulation``; none where its windows cover the period.

    A sine has no edges and is not gated.

    - ``gate_us``: Time after each edge in which events are kept, 0 to 100 000 us; 0 is no gate.

    Raises ``ArgumentError`` when ``gate_us`` is outside its range.
    """
    integer("gate_us", gate_us, 0, GATE_MAX_US)
    period_us, length_us = modulation.period_us, LEAD_US + gate_us
    if gate_us == 0 or modulation.waveform == "sine" or length_us >= period_us:
        return PhaseGate()
    step = TURN / period_us
    lead, span = round(step * LEAD_US), round(step * length_us) - 1
    off_begin = round(TURN * modulation.duty) - lead
    return PhaseGate(round(step), TURN - lead, span, off_begin % TURN, span)


class GatePart(NamedTuple):
    """A part of the period: 1 where its ON or OFF events are late, and the time of its end."""

    late_on: int
    late_off: int
    end_us: int


@kernel(_nrt=False)
def _is_outside(phase, begin, span):
    return np.uint32(phase - np.uint32(begin)) > np.uint32(span)


@kernel(_nrt=False)
def _is_late(dt_us, polarity, gate):
    """Return whether an event ``dt_us`` after a rising edge is outside the gate."""
    if gate.step == 0:
        return False
    phase = np.uint32(np.uint32(dt_us) * np.uint32(gate.step))
    if polarity:
        return _is_outside(phase, gate.on_begin, gate.on_span)
    return _is_outside(phase, gate.off_begin, gate.off_span)


@kernel(_nrt=False)
def _steps_left(phase, begin, span, step):
    """Return 1 if a phase is outside a span, and the steps after which that is no longer so."""
    if _is_outside(phase, begin, span):
        return 1, -(-np.int64(np.uint32(np.uint32(begin) - phase)) // step)
    return 0, np.int64(np.uint32(np.uint32(begin + span) - phase)) // step + 1


@kernel(_nrt=False)
def _gate_part(t_us, edge_us, gate):
    """Return the part of a gate that a time is in, which is after the rising edge."""
    if gate.step == 0:
        return GatePart(0, 0, 1 << 62)
    phase = np.uint32((t_us - edge_us) * gate.step)
    late_on, on_us = _steps_left(phase, gate.on_begin, gate.on_span, gate.step)
    late_off, off_us = _steps_left(phase, gate.off_begin, gate.off_span, gate.step)
    return GatePart(late_on, late_off, t_us + min(on_us, off_us))
