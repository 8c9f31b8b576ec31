"""From the camera's bytes to profiles."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.arrays import byte_view
from eschorty_ros.core.base.errors import ArgumentError, EschortyError
from eschorty_ros.core.base.numbers import integer, short
from eschorty_ros.core.evt3 import ActivityFilter, Decoder, Events, Triggers
from eschorty_ros.core.evt3.cuts import triggers_of
from eschorty_ros.core.line import relative_reflectance
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import Calibration
from eschorty_ros.core.reconstruction.edge_recorder import EdgeRecorder
from eschorty_ros.core.reconstruction.missing_points import missing_points
from eschorty_ros.core.reconstruction.periods import PASS_WORDS, PeriodCutter
from eschorty_ros.core.reconstruction.profile_assembler import ProfileAssembler
from eschorty_ros.core.reconstruction.profile_length import periods_max
from eschorty_ros.core.reconstruction.profiles import LineRows, Profiles
from eschorty_ros.core.reconstruction.readout_window import window_model, window_words
from eschorty_ros.core.reconstruction.region import within_ranges
from eschorty_ros.core.reconstruction.settings import Settings
from eschorty_ros.core.reconstruction.step_compensation import StepCompensator
from eschorty_ros.core.reconstruction.stream_faults import (
    decoder_counts,
    is_unreadable,
    stream_faults,
)
from eschorty_ros.core.reconstruction.windows import JOBS_MAX, WindowAssembler
from eschorty_ros.core.storage import SENSOR_EDGE

_PIECE_WORDS = 1 << 16
# Few words more than a block of the phase lock needs events.
_BLOCK_WORDS = 1 << 13
# Most pieces with edges that are kept until ``take_stage_edges`` is called. Nothing offline does.
_STAGE_EDGES_MAX = 1024


class Reconstructor:
    """Bytes in, profiles out; the same points however the bytes are split.

    One thread at a time calls it. After a call that Ctrl-C has interrupted it takes no more bytes.

    Parameters
    ----------
    calibration : Calibration
    modulation : Modulation
        Periods are cut at the rising edges of the camera's trigger input when there are any, else
        from ``on_edge_us``, else at a phase estimated from the first events (which are held back
        meanwhile, not lost).
    settings : Settings
    jobs : int
        Threads that decode and turn events into rows.

    Attributes
    ----------
    settings : Settings
    model : RangeModel
    modulation : Modulation
        The one in use.
    first_t_us : int or None
        Sensor time of the first event.
    newest_t_us : int or None
        Sensor time of the newest event.

    Raises
    ------
    ArgumentError
        When the profile is longer than the 2.1 s that the time within it can count, or the sensor
        has more than 1023 rows.
    EschortyError
        By ``push``, ``push_to`` and ``flush`` where such a call has not ended.

    Examples
    --------
    A line in row 350, 12 events in each of 8 columns, four periods of 1 kHz:

    >>> import numpy as np
    >>> from eschorty_ros.core.evt3 import Encoder
    >>> from eschorty_ros.core.modulation import Modulation
    >>> from eschorty_ros.core.optics import load_calibration
    >>> t, column, event = np.meshgrid(
    ...     np.arange(4) * 1000 + 100, np.arange(8), np.arange(12), indexing="ij"
    ... )
    >>> row = 350 + event % 3 - 1
    >>> data = Encoder().encode(t.ravel(), column.ravel(), row.ravel(), np.ones(t.size, int))
    >>> calibration = load_calibration("config_3")
    >>> reconstructor = Reconstructor(calibration, Modulation(1000.0, on_edge_us=0))
    >>> profiles = Profiles.concatenate([reconstructor.push(data), reconstructor.flush()])
    >>> profiles.profile_count, len(profiles)
    (4, 32)
    >>> print(f"row {profiles.row[0]:.1f} is at {profiles.range_mm[0]:.1f} mm")
    row 350.0 is at 1131.0 mm
    """

    def __init__(
        self,
        calibration: Calibration,
        modulation: Modulation,
        settings: Settings | None = None,
        jobs: int = 1,
    ) -> None:
        self.settings = settings = Settings() if settings is None else settings
        for name, value, kind in (
            ("calibration", calibration, Calibration),
            ("modulation", modulation, Modulation),
            ("settings", settings, Settings),
        ):
            if not isinstance(value, kind):
                raise ArgumentError(f"{name} is {short(value)}; give a {kind.__name__}")
        self.model = calibration.model()
        self._first_row, model = window_model(calibration)
        self._window_model = model
        self.first_t_us: int | None = None
        self.newest_t_us: int | None = None
        self._decoder = Decoder(model.columns, model.rows)
        self._filter: ActivityFilter | None = None
        if settings.noise_filter == "activity":
            self._filter = ActivityFilter(model.columns, model.rows)
        self._assembler: ProfileAssembler | WindowAssembler
        self._jobs = integer("jobs", jobs, 1, JOBS_MAX)
        self._assembler = (
            ProfileAssembler(settings, model)
            if jobs == 1
            else WindowAssembler(settings, model, jobs, self._hand_on)
        )
        self._compensator: StepCompensator | None = None
        self._counts = Counter(
            events=0, events_filtered=0, points=0, points_found=0, points_beyond_pole=0,
            points_outside_roi=0, points_flagged=0, points_cut=0, events_used=0,
            columns_compensated=0, periods_with_points=0,
        )  # fmt: skip
        self._watermark_us = 0
        self._periods_before = 0
        self._before_restart: list[Profiles] = []
        self._each: Callable[[Profiles], Any]
        self._stage_edges: list[tuple[NDArray[np.int64], NDArray[np.uint8]]] = []
        self._in_use = threading.Lock()
        self._begin(modulation)

    def push(self, data: bytes | bytearray | memoryview) -> Profiles:
        """Return the profiles that the next bytes of the stream complete.

        With ``reflectance_compensation`` the newest are delayed until later ones are complete.

        Parameters
        ----------
        data : bytes-like
            EVT3, cut anywhere.
        """
        found: list[Profiles] = []
        self.push_to(found.append, data)
        return Profiles.concatenate(found)

    def push_to(
        self, each: Callable[[Profiles], Any], data: bytes | bytearray | memoryview
    ) -> None:
        """Call ``each`` with the profiles that the next bytes complete, in parts, as soon as known.

        Other threads go on with later bytes meanwhile.
        """
        with self._used():
            self._each = each
            before, self._before_restart = self._before_restart, []
            for profiles in before:
                each(profiles)
            words, begin = self._decoder.words(byte_view("data", data)), 0
            if self._first_row:
                words = window_words(words, self._first_row)
            settled = False
            while begin < words.size:
                left = words[begin:]
                tracks = self._jobs > 1 and self._periods.lock.tracks
                if settled and tracks and left.size > 2 * PASS_WORDS:
                    begin += self._add_tracked(left)
                    settled = False
                else:
                    read, settled = self._add(left)
                    begin += read
            for rows in self._assembler.take():
                self._hand_on(rows)
            del self._each

    @contextmanager
    def _used(self) -> Iterator[None]:
        """Refuse a call before another one has ended; one that is interrupted never ends."""
        if not self._in_use.acquire(blocking=False):
            raise EschortyError(
                "this reconstructor is in use by another thread, or a call of it was interrupted; "
                "make another one"
            )
        try:
            yield
        except Exception:
            self._in_use.release()
            raise
        self._in_use.release()

    def _add_tracked(self, words: NDArray[np.uint16]) -> int:
        """Track the phase over ``words``, then assemble them in windows; return the number read."""
        decoder, floor_us = self._decoder.copied(), self._watermark_us
        recorder, lock, begin = EdgeRecorder(), self._periods.lock, 0
        self._periods.recorder = recorder
        while lock.tracks and begin < words.size and begin - recorder.marked <= PASS_WORDS:
            read, settled = self._add(words[begin:])
            begin += read
            if settled:
                recorder.mark(begin)
        self._periods.recorder = None
        recorder.assemble(words, decoder, floor_us, self._assembler)
        return begin

    def _add(self, words: NDArray[np.uint16]) -> tuple[int, bool]:
        """Assign the events of the first words to periods; return the number of words.

        The second value is whether no event is held back.
        """
        size, lock = _PIECE_WORDS, self._periods.lock
        if self._filter is None:
            piece = words[: PASS_WORDS if self._jobs == 1 or lock.tracks else None]
            if self._periods.triggered and piece.size > _PIECE_WORDS:
                return self._add_triggered(piece), False
            read = self._add_words(piece)
            if read:
                return read, True
            size = _BLOCK_WORDS if lock.observes else _PIECE_WORDS
        events = self._decoded(words[:size])
        self._add_triggers(events.triggers)
        self._periods.add(self._filtered(events), self._watermark_us)
        return min(size, words.size), False

    def _add_triggered(self, words: NDArray[np.uint16]) -> int:
        """Find the triggers in words, then assign all their events; return the number read."""
        ahead = self._decoder.copied()
        triggers, newest_us = triggers_of(words, ahead)
        self._add_triggers(triggers)
        watermark_us = max(self._watermark_us, ahead.settled_us or 0)
        before, floor_us = self._events_decoded, self._watermark_us
        read = self._periods.add_triggered(words, self._decoder, floor_us, watermark_us)
        self._count_since(before, newest_us)
        for begin in range(read, words.size, _PIECE_WORDS):
            events = self._decoded(words[begin : begin + _PIECE_WORDS])
            self._periods.add(events, self._watermark_us)
        return words.size

    def flush(self) -> Profiles:
        """Close the open period and return all profiles left; call at the end of the stream.

        Without any phase until here there are none, and ``phase_missing`` is set.
        """
        with self._used():
            left, self._before_restart = self._before_restart, []
            self._periods.finish(self.newest_t_us)
            left += map(self._finished, self._assembler.take())
            left.append(self._with_ranges(self._compensated(LineRows.empty(), last=True)))
        return Profiles.concatenate(left)

    def _hand_on(self, rows: LineRows) -> None:
        self._each(self._finished(rows))

    def _finished(self, rows: LineRows) -> Profiles:
        return self._with_ranges(self._compensated(self._with_reflectance(rows)))

    def _add_words(self, words: NDArray[np.uint16]) -> int:
        """Decode words into periods without storing the events; return the number read."""
        before = self._events_decoded
        read = self._periods.add_words(words, self._decoder, self._watermark_us)
        self._count_since(before, self._decoder.newest_us)
        return read

    @property
    def _events_decoded(self) -> int:
        return int(self._decoder.memory.counts["events"])

    def _count_since(self, events: int, newest_us: int) -> None:
        """Count the events decoded since there were this many; the last was at ``newest_us``."""
        new = self._events_decoded - events
        if new:
            self.newest_t_us = max(newest_us, self._watermark_us)
            self._counts["events"] += new
        self._watermark_us = max(self._watermark_us, self._decoder.settled_us or 0)

    def _decoded(self, piece: NDArray[np.uint16]) -> Events:
        """Return the events of ``piece``, stored."""
        events = self._decoder.decode_words(piece)
        if len(events):
            # Periods before it are closed: a TIME_HIGH that steps back must not reopen them.
            if events.t[0] < self._watermark_us:
                np.maximum(events.t, self._watermark_us, out=events.t)
            if self.first_t_us is None:
                self.first_t_us = int(events.t[0])
            self.newest_t_us = int(events.t[-1])
            self._counts["events"] += len(events)
        self._watermark_us = max(self._watermark_us, self._decoder.settled_us or 0)
        return events

    def _add_triggers(self, triggers: Triggers) -> None:
        source = self.settings.trigger_source
        if not len(triggers):
            return
        if source == "laser":
            self._periods.lock.schedule.add_triggers(triggers.t[triggers.edge == 1])
        elif source == "stage" and len(self._stage_edges) < _STAGE_EDGES_MAX:
            self._stage_edges.append((triggers.t.copy(), triggers.edge.copy()))

    def _filtered(self, events: Events) -> Events:
        if self._filter is None:
            return events
        kept = self._filter.filter(events)
        self._counts["events_filtered"] += len(events) - len(kept)
        return kept

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

    def _compensated(self, rows: LineRows, last: bool = False) -> LineRows:
        settings, every = self.settings, self._periods.lock.schedule.every
        if settings.reflectance_compensation == "off" or not settings.stage_speed_mm_s or not every:
            return rows
        if self._compensator is None:
            settings = replace(settings, periods_per_profile=every)
            self._compensator = StepCompensator(settings, self._window_model, self.modulation)
        rows = self._compensator.push(rows)
        return LineRows.concatenate([rows, self._compensator.flush()]) if last else rows

    def _with_ranges(self, rows: LineRows) -> Profiles:
        """Return ``rows`` with their ranges, as far as they are of interest."""
        if isinstance(rows, Profiles):
            profiles = rows
        else:
            profiles = Profiles.from_rows(rows, self._window_model)
            self._counts["points_beyond_pole"] += len(rows) - len(profiles)
        if self._first_row:
            profiles = replace(profiles, row=profiles.row + self._first_row)
        periods = profiles.profile_count * self._periods.lock.schedule.every
        self._counts["periods_with_points"] += periods
        within = within_ranges(profiles.range_mm, self.settings)
        self._counts["events_used"] += int(profiles.events.sum())
        if not within.all():
            self._counts["points_outside_roi"] += len(profiles) - int(within.sum())
            profiles = profiles.select(within)
        self._counts["points_found"] += len(profiles)
        flagged = int(np.count_nonzero(profiles.flags))
        self._counts["points_flagged"] += flagged
        if flagged:
            cut = profiles.flags & SENSOR_EDGE
            self._counts["points_cut"] += int(np.count_nonzero(cut))
        if self.settings.keep == "good":
            profiles = profiles.select(profiles.flags == 0)
        self._counts["points"] += len(profiles)
        return profiles

    def set_modulation(self, modulation: Modulation) -> None:
        """Use ``modulation`` for data pushed afterwards; the open period is closed first."""
        if modulation != self.modulation:
            self._restart(modulation)

    def set_stage_speed(self, mm_s: float) -> None:
        """Set the stage's speed towards +y, mm/s, from now on; 0 where it is not known."""
        if mm_s == self.settings.stage_speed_mm_s:
            return
        self.settings = replace(self.settings, stage_speed_mm_s=mm_s)
        self._assembler.set_stage_speed(mm_s)
        if self._compensator is not None:
            self._counts["columns_compensated"] += self._compensator.columns_compensated
            self._before_restart.append(self._with_ranges(self._compensator.flush()))
            self._compensator = None

    def restart_phase(self) -> None:
        """Estimate the phase again from the next data on: the laser has been switched on.

        Nothing happens where the phase is known, or not found yet.
        """
        if self.modulation.on_edge_us is None and self._periods.lock.schedule.anchored:
            self._restart(self.modulation)

    def _restart(self, modulation: Modulation) -> None:
        self._before_restart = [self.flush()]
        self._periods_before = self.periods_per_profile
        periods, compensator = self._periods, self._compensator
        self._begin(modulation)
        self._counts.update(periods.counters)
        if compensator is not None:
            self._counts["columns_compensated"] += compensator.columns_compensated

    def _begin(self, modulation: Modulation) -> None:
        """Start with another modulation; counters and the decoder are kept."""
        every = self.settings.periods_per_profile
        if every > periods_max(modulation):
            raise ArgumentError(
                f"periods_per_profile is {every}; {modulation.frequency_hz:g} Hz allows "
                f"{periods_max(modulation)}"
            )
        self.modulation = modulation
        self._periods = PeriodCutter(modulation, every, self._assembler)
        self._compensator = None

    def note_gap(self) -> None:
        """Note that bytes were lost before the next ``push``; periods and sensor time are kept."""
        self._decoder.note_gap()

    def take_stage_edges(self) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
        """Return the stage's trigger edges since the last call: times (us), 1 for rising.

        There are none unless ``trigger_source`` is ``stage``.
        """
        edges, self._stage_edges = self._stage_edges, []
        if not edges:
            return np.empty(0, np.int64), np.empty(0, np.uint8)
        return np.concatenate([t for t, _ in edges]), np.concatenate([kind for _, kind in edges])

    @property
    def time_us(self) -> int | None:
        """Sensor time up to which the stream has been read, events or not; ``None`` at first."""
        return self._decoder.time_us

    @property
    def settled_us(self) -> int | None:
        """Sensor time before which no event is still to come; ``None`` at first."""
        return self._decoder.settled_us

    @property
    def phase_missing(self) -> bool:
        """Return whether a flush found no phase in the events held back, and used none."""
        return self._periods.lock.missing

    @property
    def periods_per_profile(self) -> int:
        """Periods that make a profile; those before a restart until new ones are chosen, else 0."""
        return self._periods.lock.schedule.every or self._periods_before

    @property
    def warnings(self) -> list[str]:
        """Return one line for each fault of the stream, and for each reason of points that miss."""
        return self.warnings_since({})

    def warnings_since(self, before: Mapping[str, int]) -> list[str]:
        """Return the warnings about the stream since its counters were ``before``."""
        found: list[str] = []
        counts = {name: count - before.get(name, 0) for name, count in self.counters.items()}
        # Events held before count among those of a cause once they are assigned.
        counts["events"] -= counts["events_held"]
        if self._periods.fills_columns:
            found.append(
                "light that follows the laser comes from many rows of a column, and that of a line "
                "from few; turn the camera so that the line crosses all columns, or focus the laser"
            )
        elif self.phase_missing:
            found.append(
                f"no modulation at {self.modulation.frequency_hz:g} Hz found in the events; none "
                "of them is used"
            )
        if self.settings.reflectance_compensation == "on" and not self.settings.stage_speed_mm_s:
            found.append(
                "reflectance_compensation is on, but the stage rests or its speed is not known; "
                "set stage_speed_mm_s"
            )
        faults = stream_faults(counts)
        found += faults
        if not is_unreadable(counts):
            stream = self.modulation, self.model.columns, self.periods_per_profile
            found += missing_points(counts, self.settings, *stream, bool(faults))
        return found

    @property
    def counters(self) -> dict[str, int]:
        """Counts since construction, by name.

        ``events`` (decoded) = ``events_filtered`` + ``events_gated`` + ``events_binned`` +
        ``events_over_column_limit`` + ``events_outside_roi`` + ``events_outside_phase`` +
        ``events_held`` (not assigned yet).
        ``events_unmodulated`` (some of those binned) and ``columns_unmodulated`` do not follow the
        laser. ``events_used`` are those of the points, of any range.
        ``points_flagged`` are some of ``points_found`` within the limits, which are the ``points``
        unless ``keep`` is good; ``points_cut``, by the sensor's edge, are some of those.
        ``periods_closed`` had events, ``periods_empty`` none; ``periods_with_points`` are those of
        profiles with points of any range. ``sensor_drop_words``, ``broken_words`` and ``decoder_*``
        come from the decoder.
        """
        counts = Counter(self._counts)
        counts.update(self._periods.counters)
        counts.update(self._assembler.counters)
        counts["events_outside_phase"] += counts.pop("events_before_first_edge")
        if self._compensator is not None:
            counts["columns_compensated"] += self._compensator.columns_compensated
        counts.update(decoder_counts(self._decoder.counters))
        return dict(counts)
