"""From the camera's bytes to profiles."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import TIME_LIMIT, octets
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.evt3 import ActivityFilter, Decoder, Events, Triggers
from eschorty_ros.core.line import relative_reflectance
from eschorty_ros.core.line._window import TIME_LIMIT_US
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.modulation.held_events import HeldEvents
from eschorty_ros.core.modulation.phase import EDGES_MAX
from eschorty_ros.core.modulation.phase_estimate import PhaseEstimate
from eschorty_ros.core.modulation.phase_lock import FLUSH_US, PhaseLock
from eschorty_ros.core.optics import Calibration
from eschorty_ros.core.reconstruction.profile_assembler import ProfileAssembler
from eschorty_ros.core.reconstruction.profiles import LineRows, Profiles
from eschorty_ros.core.reconstruction.settings import Settings
from eschorty_ros.core.reconstruction.step_compensation import StepCompensator

PIECE_BYTES = 1 << 17
# Pieces with edges that nobody has taken; who reconstructs a file does not need them.
_STAGE_EDGES_MAX = 1024


class Reconstructor:
    """Bytes in, profiles out; the same points however the bytes are split.

    Parameters
    ----------
    calibration : Calibration
    modulation : Modulation
        Periods are cut at the rising edges of the camera's trigger input when there are any, else
        from ``on_edge_us``, else at a phase estimated from the first events (which are held back
        meanwhile, not lost).
    settings : Settings

    Raises
    ------
    ArgumentError
        When the profile is longer than the 4.19 s an event's time within it can count.
    """

    def __init__(
        self, calibration: Calibration, modulation: Modulation, settings: Settings | None = None
    ) -> None:
        self.settings = settings = settings or Settings()
        self.model = calibration.model()
        self._decoder = Decoder(self.model.columns, self.model.rows)
        self._filter = (
            ActivityFilter(self.model.columns, self.model.rows)
            if settings.noise_filter == "activity"
            else None
        )
        self._assembler = ProfileAssembler(settings, self.model)
        self._compensator: StepCompensator | None = None
        self._ready: list[Profiles] = []
        self._held = HeldEvents()
        self._counts: dict[str, int] = dict.fromkeys(
            (
                "events", "events_filtered", "events_outside_phase", "points",
                "points_beyond_pole", "columns_compensated",
            ),
            0,
        )  # fmt: skip
        self._schedule_counts: dict[str, int] = {}
        self._stage_edges: list[tuple[NDArray[np.int64], NDArray[np.uint8]]] = []
        self._settled_us = -TIME_LIMIT
        self.first_t_us: int | None = None
        self.newest_t_us: int | None = None
        self._begin(modulation)

    def _begin(self, modulation: Modulation) -> None:
        """Start over with the phase; counters and the decoder go on."""
        longest_us = modulation.period_us * (self.settings.periods_per_profile + 1)
        if longest_us >= TIME_LIMIT_US:
            raise ArgumentError(
                f"periods_per_profile is {self.settings.periods_per_profile}; "
                f"{modulation.frequency_hz:g} Hz allows "
                f"{int(TIME_LIMIT_US / modulation.period_us) - 1}"
            )
        self._modulation = modulation
        self._lock = PhaseLock(modulation, self.settings.periods_per_profile)
        self._assembler.restart(modulation)
        if self.settings.reflectance_compensation == "on" and self.settings.stage_speed_mm_s:
            self._compensator = StepCompensator(self.settings, self.model, modulation)

    @property
    def modulation(self) -> Modulation:
        """The modulation data are cut by now."""
        return self._modulation

    @property
    def time_us(self) -> int | None:
        """Sensor time up to which the stream has been read, events or not; ``None`` at first."""
        return self._decoder.time_us

    @property
    def settled_us(self) -> int | None:
        """Sensor time before which nothing comes any more; ``None`` at first."""
        return self._decoder.settled_us

    @property
    def phase_missing(self) -> bool:
        """Whether a flush found no phase and cut from the first event's time on."""
        return self._lock.missing

    @property
    def phase(self) -> PhaseEstimate | None:
        """The first estimate of the phase, ``None`` where it is known or not found yet."""
        return self._lock.estimate

    @property
    def counters(self) -> dict[str, int]:
        """Counts since construction, by name.

        ``events`` (decoded) = ``events_filtered`` + ``events_gated`` + ``events_binned`` +
        ``events_over_column_limit`` + ``events_outside_sensor`` + ``events_outside_phase`` +
        ``events_held`` (not assigned yet).
        ``periods_closed`` had events, ``periods_empty`` none. ``sensor_drop_words`` and
        ``decoder_*`` come from the decoder.
        """
        counts = dict(self._counts)
        bins = self._assembler.counters
        counts["events_outside_phase"] += bins.pop("events_before_first_edge") + self._lock.refused
        counts.update(bins)
        if self._compensator is not None:
            counts["columns_compensated"] += self._compensator.columns_compensated
        counts["events_held"] = len(self._held)
        counts["events_dropped"] = (
            counts["events_over_column_limit"]
            + counts["events_outside_sensor"]
            + counts["events_outside_phase"]
        )
        for name, value in self._lock.counters.items():
            counts[name] = value + self._schedule_counts.get(name, 0)
        counts["periods_empty"] += self._lock.schedule.periods_jumped + self._schedule_counts.get(
            "periods_jumped", 0
        )
        decoder = self._decoder.counters
        counts["sensor_drop_words"] = decoder.sensor_drop_words
        counts.update({f"decoder_{k}": int(v) for k, v in asdict(decoder).items()})
        return counts

    def push(self, data: bytes | bytearray | memoryview) -> Profiles:
        """Take the next bytes of the stream and return the profiles they complete.

        With ``reflectance_compensation`` the newest wait for those behind them.

        Parameters
        ----------
        data : bytes-like
            EVT3, cut anywhere.
        """
        view = octets("data", data)
        for begin in range(0, len(view), PIECE_BYTES):
            events = self._decoder.decode(view[begin : begin + PIECE_BYTES])
            now_us = self._decoder.settled_us
            if now_us is not None:
                # Periods before it are closed: a TIME_HIGH that steps back must not reopen them.
                if len(events) and events.t[0] < self._settled_us:
                    np.maximum(events.t, self._settled_us, out=events.t)
                self._settled_us = max(self._settled_us, now_us)
                self._absorb(events, self._settled_us)
        return self._finished()

    def flush(self) -> Profiles:
        """Close the open period; call at the end of the stream.

        Without any phase until here the periods are cut from the first event's time on and
        ``phase_missing`` is set.
        """
        self._drain()
        return self._finished(last=True)

    def _finished(self, last: bool = False) -> Profiles:
        """Return the points of the periods closed by now; with ``last`` of all."""
        rows = self._with_reflectance(self._assembler.take())
        if self._compensator is not None:
            rows = self._compensator.push(rows)
            if last:
                rows = LineRows.concatenate([rows, self._compensator.flush()])
        profiles = Profiles.from_rows(rows, self.model)
        self._counts["points"] += len(profiles)
        self._counts["points_beyond_pole"] += len(rows) - len(profiles)
        ready, self._ready = self._ready, []
        return Profiles.concatenate([*ready, profiles]) if ready else profiles

    def _with_reflectance(self, rows: LineRows) -> LineRows:
        if self.settings.reflectance == "off" or len(rows) == 0:
            return rows
        reflectance, sigma = relative_reflectance(
            rows.edge_us,
            rows.width_px,
            rows.events,
            self.settings.footprint_sigma_px,
            self.settings.white_width_px,
        )
        return replace(rows, reflectance=reflectance, reflectance_sigma=sigma)

    def note_gap(self) -> None:
        """Bytes were lost before the next ``push``: the periods' grid and the epoch stay."""
        self._decoder.note_gap()

    def set_modulation(self, modulation: Modulation) -> None:
        """Use ``modulation`` for data pushed afterwards; the open period is closed first."""
        if modulation != self._modulation:
            self._restart(modulation)

    def _restart(self, modulation: Modulation) -> None:
        self._ready = [self.flush()]
        if self._compensator is not None:
            self._counts["columns_compensated"] += self._compensator.columns_compensated
        self._counts["events_outside_phase"] += self._lock.refused
        counts = self._lock.counters
        counts["periods_jumped"] = self._lock.schedule.periods_jumped
        self._begin(modulation)
        for name, value in counts.items():
            self._schedule_counts[name] = self._schedule_counts.get(name, 0) + value

    def take_stage_edges(self) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
        """Trigger edges since the last call, if they are the stage's: times (us), 1 for rising."""
        edges, self._stage_edges = self._stage_edges, []
        if not edges:
            return np.empty(0, np.int64), np.empty(0, np.uint8)
        return np.concatenate([t for t, _ in edges]), np.concatenate([kind for _, kind in edges])

    def _take_triggers(self, triggers: Triggers) -> None:
        source = self.settings.trigger_source
        if source == "laser":
            self._lock.schedule.add_triggers(triggers.t[triggers.edge == 1])
        elif source == "stage" and len(self._stage_edges) < _STAGE_EDGES_MAX:
            self._stage_edges.append((triggers.t.copy(), triggers.edge.copy()))

    def restart_phase(self) -> None:
        """Estimate the phase anew from the next data on: the laser has been switched on.

        Nothing happens where the phase is known, or still looked for.
        """
        if self._modulation.on_edge_us is None and self._lock.schedule.anchored:
            self._restart(self._modulation)

    def _absorb(self, events: Events, now_us: int) -> None:
        self._counts["events"] += len(events)
        triggers = events.triggers
        if len(triggers):
            self._take_triggers(triggers)
        if len(events):
            if self.first_t_us is None:
                self.first_t_us = int(events.t[0])
            self.newest_t_us = int(events.t[-1])
        if self._filter is not None:
            decoded = len(events)
            events = self._filter.filter(events)
            self._counts["events_filtered"] += decoded - len(events)
        if not self._lock.schedule.anchored:
            self._held.append(events.t, events.x, events.y, events.p)
            if not self._lock.find(self._held, now_us):
                return
            self._assign(None, now_us)
        else:
            self._assign(events, now_us)

    def _assign(self, events: Events | None, watermark_us: int) -> None:
        """Put everything certain before ``watermark_us`` into periods; hold the rest back."""
        held, schedule = self._held, self._lock.schedule
        first, count = 0, 0 if events is None else len(events)
        more = True
        while more:
            if len(held):
                self._lock.skip_to(int(held.t[0]))
            elif events is not None and first < count:
                self._lock.skip_to(int(events.t[first]))
            edges, indices = schedule.advance(self._lock.limit(watermark_us))
            more = len(edges) == EDGES_MAX
            safe_us = schedule.safe_us
            edge = 0
            stop = int(np.searchsorted(held.t, safe_us))
            waiting = stop < len(held)
            last = 0
            if events is not None and not waiting:
                last = max(int(np.searchsorted(events.t, safe_us)), first)
            if stop:
                edge = self._merge(held, slice(0, stop), edges, indices, edge, last <= first)
                held.drop(stop)
            if events is not None and last > first:
                new = slice(first, last)
                edge = self._merge(events, new, edges, indices, edge, True)
                first = last
            if edge < len(edges):
                self._merge(held, slice(0, 0), edges, indices, edge, True)
            more = more or self._lock.settle(watermark_us)
        if events is not None and first < count:
            held.append(events.t[first:], events.x[first:], events.y[first:], events.p[first:])

    def _merge(
        self,
        source: Events | HeldEvents,
        part: slice,
        edges: NDArray[np.int64],
        indices: NDArray[np.int64],
        edge: int,
        drain: bool,
    ) -> int:
        t, x, y, p = source.t[part], source.x[part], source.y[part], source.p[part]
        self._lock.observe(t, p)
        return self._assembler.merge(t, x, y, p, edges, indices, edge, drain)

    def _drain(self) -> None:
        if self._lock.schedule.anchored or self._lock.find(self._held, FLUSH_US, last=True):
            self._finish()

    def _finish(self) -> None:
        """Assign what is held back and close the open period."""
        newest = self.newest_t_us
        if newest is not None:
            self._assign(None, self._lock.schedule.watermark_after(newest))
        self._assembler.close()
