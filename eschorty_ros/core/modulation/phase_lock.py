"""The phase of the modulation where it is not known: estimated from the events, then tracked."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.modulation.edges import EdgeSchedule
from eschorty_ros.core.modulation.held_events import HELD_EVENTS_MAX, HeldEvents, sample
from eschorty_ros.core.modulation.modulation import Modulation
from eschorty_ros.core.modulation.phase_estimate import (
    PhaseEstimate,
    estimate_phase,
    estimation_window,
    line_phase,
)

END_OF_STREAM_US = 1 << 61
# Length of a block: 100 ppm are then at most 0.3 % of a period up to 2 kHz, and 3 % at 20 kHz.
_BLOCK_PERIODS = 32
BLOCK_US = 16_000
_EVENTS_MIN = 128
_EVENTS_ENOUGH = 2048
# Events of the first periods that are looked at, evenly spread.
_SAMPLE = 1 << 20
_GAIN = 0.5
# Shares of the period. A larger difference is not drift but a generator that was restarted, if two
# blocks agree on it.
_DRIFT_MAX = 0.125
_AGREEMENT = 0.0625


class PhaseLock:
    """Anchors an ``EdgeSchedule`` and, where the phase was estimated, tracks it by the events.

    A generator and a sensor with clocks of their own drift apart: 100 ppm are a period of 1 kHz
    after 10 s. So the phase is estimated again for every block of periods, from events all over its
    first period or more, and the edges after the block are moved by half of the difference. Events
    of a part of a period would follow any laser. A phase that differs by more than an eighth of a
    period in two successive blocks replaces the old one: the laser was switched off and on. Blocks
    are counted in periods and closed before any later event is assigned, so the result does not
    depend on how the stream is split.

    Nothing is moved where ``on_edge_us`` is given or triggers come.

    - ``every``: See ``EdgeSchedule``.

    Public attribute ``window``: First and last of the held events that showed the phase, ``None``
    where it was known.
    """

    def __init__(self, modulation: Modulation, every: int) -> None:
        self.schedule = EdgeSchedule(modulation, every)
        self.window: tuple[int, int] | None = None
        self._ended = False
        self._modulation = modulation
        self._block = max(_BLOCK_PERIODS, round(BLOCK_US / modulation.period_us))
        self._block_end_us: int | None = None
        self._difference: float | None = None
        self._corrections = 0
        self._relocks = 0
        # Events of the block: the first one's time, those seen, and those kept, one in ``stride``.
        self._begin_us = self._seen = self._count = 0
        self._stride, self._observed = 1, False
        self._t = np.empty(2 * _EVENTS_ENOUGH, np.int64)
        self._p = np.empty(2 * _EVENTS_ENOUGH, np.uint8)

    @property
    def counters(self) -> dict[str, int]:
        """Counts by name; corrections and relocks are blocks after which edges were moved."""
        return self.schedule.counters | {
            "phase_corrections": self._corrections,
            "phase_relocks": self._relocks,
        }

    @property
    def missing(self) -> bool:
        """Return whether the stream ended without a phase, and has none since."""
        return self._ended and not self.schedule.anchored

    def find(self, held: HeldEvents, now_us: int, last: bool = False) -> bool:
        """Anchor the schedule as soon as the held events allow; return whether it is anchored.

        Drops windows without a phase beyond the limit; all of them where no more events come, with
        ``last``.
        """
        if len(held) == 0:
            return False
        first_us = int(held.arrays[0][0])
        if self._modulation.on_edge_us is not None:
            self.schedule.anchor(self._modulation.on_edge_us, first_us)
            return True
        while True:
            t = held.arrays[0]
            begin = held.searched
            window = estimation_window(t[begin:], now_us, self._modulation)
            end_us = END_OF_STREAM_US if window is None else window.end_us
            trigger_us = self.schedule.first_pair_us(end_us)
            if trigger_us is not None:
                self.schedule.anchor(trigger_us, min(first_us, trigger_us), triggered=True)
                return True
            if window is None:
                break
            end = begin + window.size
            events = sample([values[begin:end] for values in held.arrays], _SAMPLE)
            estimate = line_phase(events, self._modulation)
            if estimate.found:
                self.window = begin, end
                return self._anchor(estimate, first_us)
            held.searched = end
            if end > HELD_EVENTS_MAX:
                held.refuse(end)
                if len(held) == 0:
                    return False
                first_us = int(held.arrays[0][0])
        if last:
            estimate = line_phase(sample(held.arrays, _SAMPLE), self._modulation)
            if estimate.found:
                return self._anchor(estimate, first_us)
            self._ended = True
            held.refuse(len(held))
        return False

    def _anchor(self, estimate: PhaseEstimate, first_us: int) -> bool:
        self.schedule.anchor(estimate.edge_us, first_us)
        self._block_end_us = self.schedule.middle_after(self._block)
        return True

    def skip_to(self, t_us: int) -> None:
        """Skip periods without events before ``t_us``, the time of the next event."""
        if self._block_end_us is None or t_us < self._block_end_us:
            self.schedule.jump(t_us)
        elif self._count == 0:
            self.schedule.jump(t_us)
            self._block_end_us = self.schedule.middle_after(self._block)

    def limit(self, watermark_us: int) -> int:
        """Return the watermark up to which the edges are final: the end of the block at most."""
        if self._block_end_us is not None and self.schedule.triggered:
            self._block_end_us = None
        return watermark_us if self._block_end_us is None else min(watermark_us, self._block_end_us)

    def observe(self, t_us: NDArray[np.int64], polarity: NDArray[np.uint8]) -> None:
        """Keep enough events of the block's first period or periods; those assigned, in order."""
        if not self.observes or t_us.size == 0:
            return
        if self._seen == 0:
            self._begin_us = int(t_us[0])
        inside = int(np.searchsorted(t_us, self._begin_us + self._modulation.period_us))
        self._keep(t_us[:inside], polarity[:inside])
        more = slice(inside, inside + max(_EVENTS_ENOUGH - self._count, 0))
        self._keep(t_us[more], polarity[more])
        self._observed = inside < t_us.size and self._count >= _EVENTS_ENOUGH

    def _keep(self, t_us: NDArray[np.int64], polarity: NDArray[np.uint8]) -> None:
        """Keep one event of each stride; double the stride when there is no room."""
        at = -self._seen % self._stride
        while at < t_us.size:
            if self._count == self._t.size:
                self._count //= 2
                self._t[: self._count], self._p[: self._count] = self._t[::2], self._p[::2]
                at += (self._seen + at) % (2 * self._stride)
                self._stride *= 2
                continue
            size = min(-(-(t_us.size - at) // self._stride), self._t.size - self._count)
            old = slice(at, at + size * self._stride, self._stride)
            new = slice(self._count, self._count + size)
            self._t[new], self._p[new] = t_us[old], polarity[old]
            self._count += size
            at += size * self._stride
        self._seen += t_us.size

    def _clear_block(self) -> None:
        self._seen, self._count, self._stride, self._observed = 0, 0, 1, False

    @property
    def tracks(self) -> bool:
        """Return whether edges are moved by the events of each block."""
        return self._block_end_us is not None and not self.schedule.triggered

    @property
    def observes(self) -> bool:
        """Return whether more of the block's events have to be observed."""
        return self._block_end_us is not None and not self._observed

    def close_block(self, watermark_us: int) -> bool:
        """Close the block that ends before ``watermark_us``; return whether there was one.

        All its events must have been observed and all its edges returned.
        """
        if self._block_end_us is None or watermark_us <= self._block_end_us:
            return False
        triggered = self.schedule.triggered
        # The first block may end within a period.
        whole = self._block_end_us - self._begin_us > self._modulation.period_us
        # Edges that triggers set are not moved, nor those of the block of the first trigger.
        if self._count >= _EVENTS_MIN and whole and not triggered:
            t_us, polarity = self._t[: self._count], self._p[: self._count]
            estimate = estimate_phase(t_us, polarity, self._modulation)
            if estimate.found:
                self._correct(estimate.edge_us)
        self._clear_block()
        self._block_end_us = None if triggered else self.schedule.middle_after(self._block)
        return True

    def _correct(self, edge_us: int) -> None:
        period_us = self._modulation.period_us
        difference = (edge_us - self.schedule.last_us) / period_us
        difference -= round(difference)
        before, self._difference = self._difference, None
        if abs(difference) <= _DRIFT_MAX:
            self.schedule.shift(round(_GAIN * difference * period_us))
            self._corrections += 1
        elif before is not None and _apart(difference, before) < _AGREEMENT:
            self.schedule.shift(round(difference * period_us))
            self._relocks += 1
        else:
            self._difference = difference


def _apart(one: float, other: float) -> float:
    """Return the distance of two phases, 0 to half a period."""
    return abs(one - other - round(one - other))
