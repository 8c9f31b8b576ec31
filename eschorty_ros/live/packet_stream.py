"""Event packets in, profiles with ROS times out: losses, restarts and the camera's clock."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from eschorty_ros.core.clocks import PulseTrain, SensorClock, StageTrack
from eschorty_ros.core.evt3 import WRAP_US, first_time_high_us
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import Calibration
from eschorty_ros.core.reconstruction import (
    Profiles,
    Reconstructor,
    Settings,
    cause_of_few,
    without_modulation,
)
from eschorty_ros.live.light_warnings import LightWarnings
from eschorty_ros.live.packet_times import GAP_NS, Packet, first_time_us, overtaken, skips_time
from eschorty_ros.live.scan_recorder import ScanRecorder
from eschorty_ros.live.sensor_epoch import SensorEpoch, TimedProfiles

# Packets held while clock or modulation are unknown; further ones count as lost.
_HELD_MAX = 1000
# Packets without a TIME_HIGH, which a sensor repeats every 4 ms at least, that a decoder waits for.
_TIMELESS_MAX = 64
# A step of the numbers that no loss explains: another stream.
_LOST_MAX = 1_000_000
# An announced zero and a packet's stamp agree to this; the host may be late by some of it.
_ANNOUNCED_NS = 2_000_000_000
# Sensor time further ahead of a stamp than the first packets can have been late.
_AHEAD_NS = 5_000_000_000


class PacketStream:
    """Runs a ``Reconstructor`` over packets whose clock and modulation arrive separately.

    Packets are held, in order and bounded, until the modulation and the clock are known. The
    clock is exact when the camera's zero is announced, as a replay does. Without an announcement
    within ``clock_timeout_s`` the clock is fitted to the packets' stamps and, where the stage is
    wired to the trigger input, to its edges. Such a clock is not good to a microsecond, so the
    modulation's phase then comes from the events (or from the laser's edges).

    A packet's stamp is the time at which its first bytes arrived. The camera had collected them
    for up to ``packet_period_s`` then, which is subtracted.

    The decoder counts time from the last wrap of the stream's 24-bit time before it started. The
    packets' stamps give the number of wraps of a stream that is joined later than its first
    packet, or continues after more than half a wrap without packets.

    - ``packet_period_s``: Time over which the camera collects events before it sends them.

    Public attributes:
    - ``packets``, ``packets_lost``, ``restarts``: Packets reconstructed, missing by their ``seq``,
      and new starts of the stream.
    - ``packets_late``: Packets left out because they came twice or after later ones;
      ``packets_lost`` includes the latter.
    - ``clock_restarts``: Restarts of the clock because stamps or sensor times went back, or
      contradict each other, or the computer's clock was set.
    - ``announcements_refused``: Announced zeros that contradict the packets' stamps, which serve
      instead.
    - ``announcement_expected``: True while packets wait for an announcement of the camera's zero.
    """

    def __init__(
        self,
        calibration: Calibration,
        settings: Settings,
        clock_timeout_s: float,
        packet_period_s: float = 0.0,
    ) -> None:
        self.calibration = calibration
        self._model = calibration.model()
        self.packets = 0
        self.packets_lost = 0
        self.packets_late = 0
        self.restarts = 0
        self.clock_restarts = 0
        self.announcements_refused = 0
        self.announcement_expected = True
        self._packet_period_ns = round(packet_period_s * 1e9)
        self._settings = settings
        self._clock_timeout_s = clock_timeout_s
        self._held: deque[Packet] = deque()
        self._held_since_s: float | None = None
        self._pulses: PulseTrain | None = None
        self._epoch: SensorEpoch | None = None
        self._epoch_used = False
        self._zero_ended = False
        self._recorder: ScanRecorder | None = None
        self._reported: tuple[Modulation, int | None] | None = None
        self._override: Modulation | None = None
        self._on_since_ns: int | None = None
        self._lit_rate_hz: float | None = None
        self._reconstructor: Reconstructor | None = None
        self._wraps = 0
        self._next_seq: int | None = None
        self._source = b""
        self._last_stamp_ns = 0
        self._retired: Counter[str] = Counter()
        self._warnings = LightWarnings()
        self._out: list[TimedProfiles] = []

    @property
    def held(self) -> int:
        """Return the number of packets that wait for clock or modulation."""
        return len(self._held)

    @property
    def waits_for(self) -> str:
        """Return the missing input that packets are held for, ``""`` when none is missing."""
        if self._laser is None:
            return "modulation"
        if self._epoch is None:
            return "camera clock"
        return "sensor's time" if self._reconstructor is None and self._held else ""

    @property
    def _laser(self) -> tuple[Modulation, int | None] | None:
        """Return the modulation that is used and the ROS time of an edge, as far as known."""
        return self._reported if self._override is None else (self._override, None)

    @property
    def epoch(self) -> SensorEpoch | None:
        """Return the stream's epoch, ``None`` while its clock is unknown."""
        return self._epoch

    @property
    def frequency_hz(self) -> float:
        """Return the frequency of the modulation, 0 while that is unknown."""
        return 0.0 if self._laser is None else self._laser[0].frequency_hz

    @property
    def profile_rate_hz(self) -> float:
        """Return the profiles per second of the light that is on or was last, 0 while unknown.

        Until the stream has shown how many periods make a profile, it is one.
        """
        if self._lit_rate_hz is not None:
            return self._lit_rate_hz
        every = 0 if self._reconstructor is None else self._reconstructor.periods_per_profile
        return self.frequency_hz / (every or self._settings.periods_per_profile or 1)

    @property
    def processed_until_ns(self) -> int | None:
        """Return the ROS time up to which the stream has been reconstructed."""
        # Also read by other threads than the one that processes.
        reconstructor, epoch = self._reconstructor, self._epoch
        newest_us = reconstructor.time_us if reconstructor is not None else None
        line = epoch.clock.line if epoch is not None else None
        if newest_us is None or line is None:
            return None
        return line.to_ns(newest_us + self._wraps * WRAP_US)

    @property
    def counters(self) -> Counter[str]:
        """Return the counters of all reconstructors of the stream, summed by name."""
        total, reconstructor = Counter(self._retired), self._reconstructor
        if reconstructor is not None:
            total.update(reconstructor.counters)
        return total

    @property
    def warnings(self) -> list[str]:
        """Return the warnings about the light that is on or was last, one line for each reason.

        Where it is not known when the laser is on they are about the stream since the scan began.
        """
        if 2 * self.restarts > self.packets > 1:
            return [
                f"camera/events began again {self.restarts:,} times in {self.packets:,} packets; "
                "seq has to be one more with each packet: let the driver number them"
            ]
        laser_hz = 0.0 if self._reported is None else self._reported[0].frequency_hz
        return self._warnings.lines(self._reconstructor, self._settings, laser_hz)

    def cause_of_no_points(self, before: Mapping[str, int]) -> str:
        """Return what the counts since they were ``before`` show of a scan without points."""
        counts = self.counters
        counts.subtract(before)
        if counts["points_without_time"]:
            return (
                f"{counts['points_without_time']:,} points had no time, as the camera's clock was "
                "not known; look at the stamps of camera/events"
            )
        dark = without_modulation(counts["events"], self.frequency_hz)
        # Without a phase of the laser no event gets into a column.
        modulated = counts["events_binned"] > 0
        return cause_of_few(self._settings, counts, 0, dark, modulated) or dark

    def announce_zero(self, zero_ns: int) -> None:
        """Set the exact clock: sensor time 0 was ROS time ``zero_ns``."""
        epoch = self._epoch
        self._zero_ended = False
        if epoch is not None and epoch.clock.exact and epoch.clock.zero_ns == zero_ns:
            self._epoch_used = False
            return
        self._retire()
        self._begin_epoch(SensorClock(zero_ns))

    def drop_zero(self) -> None:
        """Drop an announced zero before the next scan: its sender has ended."""
        self._zero_ended = True

    def restart_clock(self) -> bool:
        """Fit the clock to the stamps that come now, as those so far are of another time.

        Returns whether points move with it: an announced zero stays.
        """
        if self._epoch is None or self._epoch.clock.exact:
            return False
        self._begin_epoch(SensorClock())
        self.clock_restarts += 1
        if self._reconstructor is not None:
            self._reconstructor.set_modulation(self._modulation())
        return True

    def begin_scan(self, recorder: ScanRecorder | None = None) -> None:
        """Drop the state that senders have left behind; record the packets from here on."""
        self._recorder = recorder
        if recorder is not None:
            self._renew()
        self._warnings.restart(self._reconstructor)
        self._lit_rate_hz = None
        if self._zero_ended and self._epoch is not None and self._epoch.clock.exact:
            self._retire()
            self._epoch = None
        self._zero_ended = False

    def set_stage_speed(self, mm_s: float) -> None:
        """Set the stage's speed towards +y for packets processed later."""
        self._settings = replace(self._settings, stage_speed_mm_s=mm_s)
        if self._reconstructor is not None:
            self._reconstructor.set_stage_speed(mm_s)

    def end_recording(self) -> None:
        """Record no more packets."""
        self._recorder = None

    def set_laser(
        self, modulation: Modulation, epoch_ns: int | None, on_since_ns: int | None = None
    ) -> None:
        """Use this modulation and ROS time of one rising edge for packets processed later.

        ``on_since_ns`` is when the laser was switched on, ``None`` while it is off. Its phase
        restarts then, unless ``epoch_ns`` gives it. An override goes before the modulation.
        """
        switched_on = on_since_ns is not None and on_since_ns != self._on_since_ns
        # A new phase of light that goes on, as after a change of its frequency, is no new light.
        new_light = on_since_ns is not None and self._on_since_ns is None
        if on_since_ns is None and self._on_since_ns is not None:
            self._warnings.end(self.warnings)
            # What is set from here on is for the next light.
            self._lit_rate_hz = self.profile_rate_hz
            if self._recorder is not None:
                self._recorder.laser_off()
        self._on_since_ns = on_since_ns
        before, self._reported = self._laser, (modulation, epoch_ns)
        self._follow_laser(before)
        if self._reconstructor is not None and switched_on:
            self._reconstructor.restart_phase()
        if new_light:
            self._warnings.restart(self._reconstructor)
            self._lit_rate_hz = None
        if self._recorder is not None and switched_on:
            self._recorder.laser_on()

    def set_override(self, modulation: Modulation | None) -> None:
        """Use this modulation instead of the laser's, which ``None`` restores."""
        before, self._override = self._laser, modulation
        self._follow_laser(before)

    def _follow_laser(self, before: tuple[Modulation, int | None] | None) -> None:
        """Reconstruct with what is used of the laser, where that differs from ``before``."""
        if before is None or before == self._laser:
            return
        modulation = self._laser[0] if self._laser is not None else None
        if modulation != before[0] and self._on_since_ns is not None:
            self._warnings.note_change()
        if self._reconstructor is None:
            return
        if modulation and self._reconstructor.settings == self._settings.allowed(modulation):
            self._reconstructor.set_modulation(self._modulation())
        else:
            self._renew()

    def set_pulses(self, pulses: PulseTrain | None) -> None:
        """Expect these pulses, or none, if the trigger input is wired to the stage."""
        self._pulses = pulses
        if self._epoch is not None:
            self._epoch.set_pulses(self._expected_pulses())

    def fit_edges(self, track: StageTrack, *, now: bool = False) -> None:
        """Fit the clock to the stage's edges that are due, with ``now`` to all of them."""
        if self._epoch is not None:
            self._epoch.fit_edges(track, now=now)

    def set_settings(self, settings: Settings) -> None:
        """Use ``settings`` for packets processed later; the open period is closed first."""
        if settings == self._settings:
            return
        self._settings = settings
        self.set_pulses(self._pulses)
        self._renew()

    def set_calibration(self, calibration: Calibration) -> None:
        """Use ``calibration`` for packets processed later; the open period is closed first."""
        self._renew()
        self.calibration = calibration
        self._model = calibration.model()

    def add(self, packet: Packet, now_s: float) -> None:
        """Queue one packet that arrived at ``now_s`` of the steady clock."""
        if self._held_since_s is None:
            self._held_since_s = now_s
        if len(self._held) < _HELD_MAX:
            self._held.append(packet)

    def process(self, now_s: float) -> list[TimedProfiles]:
        """Reconstruct the packets that need not wait; return the profiles completed since."""
        while self._held:
            if self._held[0].source == self._source and overtaken(
                self._held[0], self._next_seq, self._last_stamp_ns
            ):
                self._held.popleft()
                self.packets_late += 1
                continue
            if self._next_seq is not None and not self._goes_on(self._held[0]):
                self._end_stream()
            self._source = self._held[0].source
            if not self._ready(self._held[0], now_s):
                break
            self._push(self._consecutive())
            self._held_since_s = now_s
        if not self._held:
            self._held_since_s = None
        return self._completed()

    def flush(self) -> list[TimedProfiles]:
        """Close the open period; return the profiles completed since the last call."""
        if self._reconstructor is not None:
            self._collect(self._reconstructor.flush())
        return self._completed()

    def _consecutive(self) -> list[Packet]:
        """Remove and return the first packet held and those that continue it without a loss."""
        packets = [self._held.popleft()]
        while self._held:
            last, packet = packets[-1], self._held[0]
            if (packet.source, packet.seq) != (last.source, last.seq + 1):
                break
            if packet.stamp_ns - last.stamp_ns > GAP_NS:
                break
            packets.append(self._held.popleft())
        return packets

    def _goes_on(self, packet: Packet) -> bool:
        assert self._next_seq is not None
        missing = packet.seq - self._next_seq
        return packet.source == self._source and 0 <= missing <= _LOST_MAX

    def _end_stream(self) -> None:
        self._retire()
        self.restarts += 1
        self._next_seq = None
        if self._epoch_used:
            self._epoch = None

    def _ready(self, packet: Packet, now_s: float) -> bool:
        if self._laser is None or not self._is_timed():
            return False
        if self._epoch is None:
            since_s = now_s if self._held_since_s is None else self._held_since_s
            if self.announcement_expected and now_s - since_s < self._clock_timeout_s:
                return False
            self._begin_epoch(SensorClock())
        return True

    def _is_timed(self) -> bool:
        """Return whether the decoder has a time, or the packets held give it one."""
        if self._reconstructor is not None or len(self._held) > _TIMELESS_MAX:
            return True
        return _time_high_us(self._held) is not None

    def _begin_epoch(self, clock: SensorClock) -> None:
        self._epoch = SensorEpoch(clock, self._expected_pulses())
        self._epoch_used = False

    def _expected_pulses(self) -> PulseTrain | None:
        return self._pulses if self._settings.trigger_source == "stage" else None

    def _push(self, packets: list[Packet]) -> None:
        """Reconstruct consecutive packets, one piece of the stream."""
        packet, last = packets[0], packets[-1]
        missing = 0 if self._next_seq is None else packet.seq - self._next_seq
        self.packets_lost += missing
        time_us = self._reconstructor.time_us if self._reconstructor is not None else None
        # Without a number left out, the host may have stalled.
        if packet.stamp_ns - self._last_stamp_ns > GAP_NS and (
            missing or skips_time(packet.data, time_us)
        ):
            self._retire()
            self._next_seq = None
        if self._reconstructor is None:
            self._wraps = self._missed_wraps(packet, _time_high_us(packets))
            modulation = self._modulation()
            self._reconstructor = Reconstructor(
                self.calibration, modulation, self._settings.allowed(modulation)
            )
        elif missing:
            self._reconstructor.note_gap()
        if self._recorder is not None:
            assert self._epoch is not None
            run = self._reconstructor, self._epoch
            for part in packets:
                self._recorder.packet(part, missing if part is packet else 0, run, self._wraps)
        reconstructor, before_us = self._reconstructor, self._reconstructor.settled_us
        # One call for all packets that wait: each call costs as much as the events of one packet.
        profiles = reconstructor.push(
            b"".join(part.data for part in packets) if len(packets) > 1 else packet.data
        )
        self._observe(packet, before_us, reconstructor)
        self._collect(profiles)
        self._next_seq = last.seq + 1
        self._last_stamp_ns = last.stamp_ns
        self._epoch_used = True
        self.packets += len(packets)

    def _observe(self, packet: Packet, before_us: int | None, after: Reconstructor) -> None:
        """Add the stamp of the first packet pushed, and the edges of all, to the clock."""
        assert self._epoch is not None
        shift_us = self._wraps * WRAP_US
        t_us = first_time_us(packet.data, before_us, after.time_us)
        if t_us is not None:
            arrival_ns = packet.stamp_ns - self._packet_period_ns
            clock = self._epoch.clock
            if self._contradicts(clock, t_us + shift_us, arrival_ns):
                self._begin_epoch(clock := SensorClock())
                after.set_modulation(self._modulation())
            clock.observe(t_us + shift_us, arrival_ns)
        edges_us, kinds = after.take_stage_edges()
        self._epoch.edges.add(edges_us + shift_us, kinds)

    def _contradicts(self, clock: SensorClock, t_us: int, arrival_ns: int) -> bool:
        """Return whether an arrival cannot be by this clock; count it."""
        ahead_ns = 0 if clock.line is None else clock.to_ns(t_us) - arrival_ns
        if clock.exact:
            refused = abs(ahead_ns) > _ANNOUNCED_NS
            self.announcements_refused += refused
            return refused
        restarts = ahead_ns > _AHEAD_NS or not clock.goes_on(t_us, arrival_ns)
        self.clock_restarts += restarts
        return restarts

    def _missed_wraps(self, packet: Packet, high_us: int | None) -> int:
        """Return the number of wraps before this packet that a new decoder has not decoded."""
        assert self._epoch is not None
        clock = self._epoch.clock
        if packet.seq == 0 or clock.line is None or high_us is None:
            return 0
        # In a stream that continues, the newest time is closer to this packet than a stamp.
        known_ns = self._last_stamp_ns if self._next_seq == packet.seq else packet.stamp_ns
        return max(round((clock.to_us(known_ns) - high_us) / WRAP_US), 0)

    def _modulation(self) -> Modulation:
        assert self._laser is not None
        modulation, epoch_ns = self._laser
        if epoch_ns is None or self._epoch is None or not self._epoch.clock.exact:
            return modulation
        edge_us = self._epoch.clock.to_us(epoch_ns) - self._wraps * WRAP_US
        return replace(modulation, on_edge_us=edge_us)

    def _renew(self) -> None:
        """End the reconstructor; the next packet starts one at the same time."""
        if self._reconstructor is not None:
            self._last_stamp_ns = self.processed_until_ns or self._last_stamp_ns
            self._retire()

    def _retire(self) -> None:
        """End the reconstructor: close its period, keep its counters."""
        if self._reconstructor is None:
            return
        reconstructor = self._reconstructor
        self._collect(reconstructor.flush())
        # In this order, as other threads read the counters.
        self._reconstructor = None
        self._warnings.count_from(None)
        self._retired.update(reconstructor.counters)

    def _collect(self, profiles: Profiles) -> None:
        assert self._epoch is not None
        if self._epoch.clock.line is None:
            self._retired["points_without_time"] += len(profiles)
        elif len(profiles):
            build = self._model, self.calibration.stage_direction
            shift_us = self._wraps * WRAP_US
            self._out.append(TimedProfiles.within(self._epoch, profiles, shift_us, *build))

    def _completed(self) -> list[TimedProfiles]:
        out, self._out = self._out, []
        return out


def _time_high_us(packets: Iterable[Packet]) -> int | None:
    """Return the time of the first TIME_HIGH of packets, ``None`` without one."""
    times = (first_time_high_us(packet.data) for packet in packets)
    return next((t_us for t_us in times if t_us is not None), None)


def clock_statistics(stream: PacketStream) -> dict[str, Any]:
    """Return offset age, drift and residual of the sensor's clock, and its use of stage edges."""
    epoch = stream.epoch
    counts = {
        "clock_restarts": stream.clock_restarts,
        "clock_announcements_refused": stream.announcements_refused,
    }
    if epoch is None:
        return {"clock": "unknown", **counts}
    clock, fit = epoch.clock, epoch.edges.fit
    source = "stage edges" if clock.from_edges else "packet stamps"
    residual_ns = clock.residual_ns
    values: dict[str, Any] = {
        "clock": "announced" if clock.exact else f"from {source}",
        "clock_drift_ppm": clock.drift_ppm,
        "clock_residual_ms": residual_ns * 1e-6 if residual_ns is not None else float("nan"),
        "clock_offset_age_s": clock.offset_age_us * 1e-6,
        **counts,
    }
    if epoch.expects_edges:
        values |= {
            "stage_edges_kept": len(epoch.edges),
            "stage_edges_dropped": epoch.edges.edges_dropped,
            "stage_edges_used": fit.used if fit is not None else 0,
            "stage_edges_missing": fit.missing if fit is not None else 0,
            "stage_edges_spurious": fit.spurious if fit is not None else 0,
            "stage_edges_residual_um": fit.residual_mm * 1e3 if fit is not None else float("nan"),
        }
    return values
