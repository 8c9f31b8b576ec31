"""From the camera's bytes to profiles, and from a recording to a cloud."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core import _binning as binning
from eschorty_ros.core import _centroid_kernels as kernels
from eschorty_ros.core.calibration import Calibration
from eschorty_ros.core.centroid import check_method, half_width_fixed, method_factor
from eschorty_ros.core.errors import ArgumentError
from eschorty_ros.core.evt3 import Decoder, Events
from eschorty_ros.core.held_events import HeldEvents
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.noise import ActivityFilter
from eschorty_ros.core.phase import (
    EDGES_MAX,
    EdgeSchedule,
    PhaseEstimate,
    decide_window,
    estimate_phase,
)
from eschorty_ros.core.profiles import Profiles, place, place_link
from eschorty_ros.core.raw_file import RawReader
from eschorty_ros.core.recording import Recording
from eschorty_ros.core.settings import Settings

__all__ = [
    "Profiles",
    "Reconstructor",
    "Result",
    "Settings",
    "place",
    "place_link",
    "reconstruct_recording",
]

PIECE_BYTES = 1 << 17
_FLUSH_US = 1 << 61
_HELD_EVENTS_MAX = 1 << 22
_OUTPUT_PROFILES = 64


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
        self._columns, self._rows = self.model.columns, self.model.rows
        if self._rows > kernels.ROW_LAST + 1:
            raise ArgumentError(
                f"rows is {self._rows}; the reconstruction takes {kernels.ROW_LAST + 1} at most"
            )
        self._decoder = Decoder(self._columns, self._rows)
        self._filter = (
            ActivityFilter(self._columns, self._rows)
            if settings.noise_filter == "activity"
            else None
        )
        self._half_max = half_width_fixed(settings.line_width_px)
        self._allocate()
        self._held = HeldEvents()
        self._done: list[Profiles] = []
        self._counts: dict[str, int] = dict.fromkeys(
            ("events", "events_outside_phase", "points", "points_beyond_pole"), 0
        )
        self._schedule_counts: dict[str, int] = {}
        self.first_t_us: int | None = None
        self.newest_t_us: int | None = None
        self._begin(modulation)

    def _allocate(self) -> None:
        s, columns = self.settings, self._columns
        self._lists = np.empty((columns, s.column_limit + kernels.BLOCK), dtype=np.uint32)
        self._column_counts = np.zeros(columns, dtype=np.uint32)
        self._seeds = np.full(columns, -1, dtype=np.int64)
        self._state = np.zeros(binning.S_SIZE, dtype=np.int64)
        self._bin_counts = np.zeros(len(binning.COUNTERS), dtype=np.int64)
        self._work = np.zeros((4, columns))
        self._work_int = np.zeros((3, columns), dtype=np.int64)
        self._scratch = np.zeros(1 << kernels.ROW_BITS, dtype=np.int64)
        self._whole = np.zeros(binning.P_SIZE, dtype=np.int64)
        self._whole[binning.P_METHOD] = check_method(s.centroid)
        self._whole[binning.P_EVENTS_MIN] = s.events_min
        self._whole[binning.P_HALF_MAX] = self._half_max
        self._whole[binning.P_ROWS] = self._rows
        self._whole[binning.P_SMOOTH] = s.smoothing_half_width
        self._whole[binning.P_WEAK] = s.isolation_events
        self._fractional = np.zeros(binning.F_SIZE)
        self._fractional[binning.F_FACTOR] = method_factor(s.centroid, s.sigma_factor)
        self._fractional[binning.F_FLOOR] = s.sigma_floor_px
        self._fractional[binning.F_GATE] = s.smoothing_gate_px
        self._fractional[binning.F_ISOLATION] = s.isolation_gate_px
        size = _OUTPUT_PROFILES * columns
        self._out = (
            np.empty(size, dtype=np.int64),
            np.empty(size, dtype=np.int64),
            np.empty(size, dtype=np.int64),
            np.empty(size, dtype=np.uint16),
            np.empty(size, dtype=np.float64),
            np.empty(size, dtype=np.float64),
            np.empty(size, dtype=np.uint32),
        )

    def _begin(self, modulation: Modulation) -> None:
        """Start over with the phase; counters and the decoder go on."""
        longest_us = modulation.period_us * (self.settings.periods_per_profile + 1)
        if longest_us >= kernels.TIME_LIMIT_US:
            raise ArgumentError(
                f"periods_per_profile is {self.settings.periods_per_profile}; "
                f"{modulation.frequency_hz:g} Hz allows "
                f"{int(kernels.TIME_LIMIT_US / modulation.period_us) - 1}"
            )
        self._modulation = modulation
        self._schedule = EdgeSchedule(modulation, self.settings.periods_per_profile)
        self._state[binning.S_OPEN] = 0
        self._state[binning.S_HALF] = self._half_max
        self._seeds[:] = -1
        self.phase: PhaseEstimate | None = None
        self._phase_missing = False

    @property
    def modulation(self) -> Modulation:
        """The modulation data are cut by now."""
        return self._modulation

    @property
    def time_us(self) -> int | None:
        """Sensor time up to which the stream has been read, events or not; ``None`` at first."""
        return self._decoder.time_us

    @property
    def phase_missing(self) -> bool:
        """Whether a flush found no phase and cut from the first event's time on."""
        return self._phase_missing

    @property
    def counters(self) -> dict[str, int]:
        """Counts since construction, by name.

        ``events`` (decoded) = ``events_filtered`` + ``events_binned`` + ``events_over_column_limit``
        + ``events_outside_sensor`` + ``events_outside_phase`` + ``events_held`` (not assigned yet).
        ``periods_closed`` had events, ``periods_empty`` none. ``sensor_drop_words`` and
        ``decoder_*`` come from the decoder.
        """
        counts = dict(self._counts)
        bins = dict(zip(binning.COUNTERS, self._bin_counts.tolist(), strict=True))
        counts["events_outside_phase"] += bins.pop("events_before_first_edge")
        counts.update(bins)
        counts["events_held"] = len(self._held)
        counts["events_filtered"] = counts["events"] - counts["events_held"] - sum(
            counts[name]
            for name in (
                "events_binned",
                "events_over_column_limit",
                "events_outside_sensor",
                "events_outside_phase",
            )
        )
        counts["events_dropped"] = (
            counts["events_over_column_limit"]
            + counts["events_outside_sensor"]
            + counts["events_outside_phase"]
        )
        for name, value in self._schedule.counters.items():
            counts[name] = value + self._schedule_counts.get(name, 0)
        counts["periods_empty"] += (
            self._schedule.periods_jumped + self._schedule_counts.get("periods_jumped", 0)
        )
        decoder = self._decoder.counters
        counts["sensor_drop_words"] = decoder.sensor_drop_words
        counts.update({f"decoder_{k}": int(v) for k, v in asdict(decoder).items()})
        return counts

    def push(self, data: bytes | bytearray | memoryview | NDArray[np.uint8]) -> Profiles:
        """Take the next bytes of the stream and return the profiles they complete.

        Parameters
        ----------
        data : bytes-like
            EVT3, cut anywhere.
        """
        view = memoryview(data).cast("B")
        for begin in range(0, len(view), PIECE_BYTES):
            events = self._decoder.decode(view[begin : begin + PIECE_BYTES])
            now_us = self._decoder.time_us
            if now_us is not None:
                self._absorb(events, now_us)
        return self._take()

    def flush(self) -> Profiles:
        """Close the open period; call at the end of the stream.

        Without any phase until here the periods are cut from the first event's time on and
        ``phase_missing`` is set.
        """
        self._drain()
        return self._take()

    def note_gap(self) -> None:
        """Bytes were lost before the next ``push``: the periods' grid and the epoch stay."""
        self._decoder.note_gap()

    def set_modulation(self, modulation: Modulation) -> None:
        """Use ``modulation`` for data pushed afterwards; the open period is closed first."""
        if modulation == self._modulation:
            return
        self._drain()
        counts = self._schedule.counters
        counts["periods_jumped"] = self._schedule.periods_jumped
        self._begin(modulation)
        for name, value in counts.items():
            self._schedule_counts[name] = self._schedule_counts.get(name, 0) + value

    def _absorb(self, events: Events, now_us: int) -> None:
        self._counts["events"] += len(events)
        triggers = events.triggers
        if len(triggers):
            self._schedule.add_triggers(triggers.t[triggers.edge == 1])
        if len(events):
            if self.first_t_us is None:
                self.first_t_us = int(events.t[0])
            self.newest_t_us = int(events.t[-1])
        if self._filter is not None:
            events = self._filter.filter(events)
        if not self._schedule.anchored:
            self._held.append(events.t, events.x, events.y, events.p)
            if not self._find_phase(now_us):
                return
            self._assign(None, now_us)
        else:
            self._assign(events, now_us)

    def _find_phase(self, now_us: int, last: bool = False) -> bool:
        """Anchor the schedule as soon as the held events allow; drops windows beyond the limit."""
        held = self._held
        if len(held) == 0:
            return False
        first_us = int(held.t[0])
        if self._modulation.on_edge_us is not None:
            self._schedule.anchor(self._modulation.on_edge_us, first_us)
            return True
        begin = held.refused
        while True:
            decided = decide_window(held.t[begin:], now_us, self._modulation)
            size, end_us = decided or (0, _FLUSH_US)
            trigger = self._schedule.first_trigger_us
            if trigger is not None and trigger <= end_us:
                self._schedule.anchor(trigger, min(first_us, trigger))
                return True
            if decided is None:
                break
            window = slice(begin, begin + size)
            estimate = estimate_phase(held.t[window], held.p[window], self._modulation)
            if estimate.found:
                return self._anchor_estimate(estimate, first_us)
            begin += size
            held.refused = begin
            if begin > _HELD_EVENTS_MAX:
                self._counts["events_outside_phase"] += begin
                held.drop(begin)
                begin = 0
                if len(held) == 0:
                    return False
                first_us = int(held.t[0])
        if last:
            estimate = estimate_phase(held.t, held.p, self._modulation)
            if estimate.found:
                return self._anchor_estimate(estimate, first_us)
            self._phase_missing = True
            self._schedule.anchor(first_us, first_us)
        return last

    def _anchor_estimate(self, estimate: PhaseEstimate, first_us: int) -> bool:
        self.phase = estimate
        self._schedule.anchor(estimate.edge_us, first_us)
        return True

    def _assign(self, events: Events | None, watermark_us: int) -> None:
        """Put everything certain before ``watermark_us`` into periods; hold the rest back."""
        held = self._held
        first, count = 0, 0 if events is None else len(events)
        more = True
        while more:
            if len(held):
                self._schedule.jump(int(held.t[0]))
            elif events is not None and first < count:
                self._schedule.jump(int(events.t[first]))
            edges, indices = self._schedule.advance(watermark_us)
            more = len(edges) == EDGES_MAX
            safe_us = self._schedule.safe_us
            edge = 0
            stop = int(np.searchsorted(held.t, safe_us))
            waiting = stop < len(held)
            last = 0
            if events is not None and not waiting:
                last = max(int(np.searchsorted(events.t, safe_us)), first)
            if stop:
                edge = self._merge(
                    held.t, held.x, held.y, 0, stop, edges, indices, edge, last <= first
                )
                held.drop(stop)
            if events is not None and last > first:
                edge = self._merge(
                    events.t, events.x, events.y, first, last, edges, indices, edge, True
                )
                first = last
            if edge < len(edges):
                self._merge(held.t, held.x, held.y, 0, 0, edges, indices, edge, True)
        if events is not None and first < count:
            held.append(events.t[first:], events.x[first:], events.y[first:], events.p[first:])

    def _merge(
        self,
        t: NDArray[np.int64],
        x: NDArray[np.uint16],
        y: NDArray[np.uint16],
        first: int,
        stop: int,
        edges: NDArray[np.int64],
        indices: NDArray[np.int64],
        edge: int,
        drain: bool,
    ) -> int:
        """Run the compiled pass to its end, emptying the output whenever it is full."""
        while True:
            first, edge = binning._bin(
                t, x, y, first, stop, edges, indices, edge, len(edges), drain, self._lists,
                self._column_counts, self._seeds, self._state, self._whole, self._fractional,
                self._work, self._work_int, self._scratch, self._bin_counts, self._out,
            )  # fmt: skip
            if first == stop and (edge == len(edges) or not drain):
                return edge
            if self._state[binning.S_POINTS] == 0:
                raise AssertionError("the compiled pass stopped without being through")
            self._collect()

    def _drain(self) -> None:
        if not self._schedule.anchored:
            if not self._find_phase(_FLUSH_US, last=True):
                return
        self._finish()

    def _finish(self) -> None:
        """Assign what is held back and close the open period."""
        held = self._held
        newest = self.newest_t_us
        if newest is not None:
            self._assign(None, self._schedule.watermark_after(newest))
        if len(held):
            raise AssertionError("events were left over at a flush")
        if self._state[binning.S_OPEN] == 2:
            edges = self._state[[binning.S_EDGE]]
            indices = self._state[[binning.S_INDEX]]
            self._merge(held.t, held.x, held.y, 0, 0, edges, indices, 0, True)

    def _collect(self) -> None:
        """Turn the output buffer's rows into ranges and empty it."""
        n = int(self._state[binning.S_POINTS])
        self._state[binning.S_POINTS] = 0
        if n == 0:
            return
        period, edge, t, column, row, sigma, events = (a[:n].copy() for a in self._out)
        profiles = Profiles(
            period, edge, t, column, row, sigma,
            self.model.range_mm(row), self.model.range_sigma_mm(row, sigma), events,
        )  # fmt: skip
        valid = np.isfinite(profiles.range_mm)
        if not valid.all():
            self._counts["points_beyond_pole"] += int(n - valid.sum())
            profiles = profiles.select(valid)
        self._counts["points"] += len(profiles)
        self._done.append(profiles)

    def _take(self) -> Profiles:
        self._collect()
        done, self._done = self._done, []
        return done[0] if len(done) == 1 else Profiles.concatenate(done)


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """What a recording gave.

    Attributes
    ----------
    points : ndarray of POINT_DTYPE
        In ``eschorty_base``; ``t`` in seconds since the first event.
    profiles : Profiles
        The same points before placing, with their rows and times.
    counters : dict
        Those of the reconstructor, and ``points_without_stage``.
    profile_count, events : int
    seconds : float
        Wall time of reconstruction and placing, reading of the file included.
    warnings : tuple of str
        One line each.
    """

    points: NDArray[np.void]
    profiles: Profiles
    counters: dict[str, int]
    profile_count: int
    events: int
    seconds: float
    warnings: tuple[str, ...]

    @property
    def events_per_second(self) -> float:
        """Events over wall time."""
        return self.events / self.seconds if self.seconds > 0.0 else 0.0


def reconstruct_recording(
    recording: Recording,
    settings: Settings | None = None,
    progress: Callable[[int, int], Any] | None = None,
) -> Result:
    """Reconstruct a whole recording.

    Parameters
    ----------
    recording : Recording
    settings : Settings, optional
    progress : callable, optional
        Called with bytes read so far and bytes in all.

    Returns
    -------
    Result

    Raises
    ------
    FormatError
        When the event file is not EVT3.
    """
    began = time.perf_counter()
    reconstructor = Reconstructor(recording.calibration, recording.modulation, settings)
    total = recording.events_path.stat().st_size
    reader = RawReader(recording.events_path)
    parts: list[Profiles] = []
    done = 0
    for chunk in reader.chunks(1 << 20):
        parts.append(reconstructor.push(chunk))
        done += len(chunk)
        if progress is not None:
            progress(done, total)
    parts.append(reconstructor.flush())
    profiles = Profiles.concatenate(parts)
    position = recording.stage.position_mm(profiles.t_us)
    known = np.isfinite(position)
    if not known.all():
        profiles = profiles.select(known)
    origin_us = reconstructor.first_t_us or 0
    points = place(
        profiles,
        reconstructor.model,
        position[known],
        recording.calibration.stage_direction,
        origin_us,
    )
    counters = reconstructor.counters
    counters["points_without_stage"] = int(known.size - known.sum())
    warnings = [str(line) for line in reader.warnings]
    if reconstructor.phase_missing:
        warnings.append(
            "no modulation phase found in the events; periods are cut from the first event on"
        )
    return Result(
        points,
        profiles,
        counters,
        profiles.profile_count,
        counters["events"],
        time.perf_counter() - began,
        tuple(warnings),
    )
