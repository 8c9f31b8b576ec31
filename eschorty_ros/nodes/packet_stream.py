"""Event packets in, profiles with ROS times out: losses, restarts and the camera's clock."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from eschorty_ros.core.calibration import Calibration
from eschorty_ros.core.clock import NS_PER_US, SensorClock
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.reconstruction import Profiles, Reconstructor, Settings
from eschorty_ros.nodes.stage_placer import TimedProfiles

WRAP_US = 1 << 24
_GAP_NS = WRAP_US * NS_PER_US // 2
_TIME_HIGH = 0x8


@dataclass(frozen=True, slots=True)
class Packet:
    """One ``EventPacket``: ``data`` is a buffer of EVT3 words, ``stamp_ns`` its arrival time."""

    seq: int
    stamp_ns: int
    data: Any


def first_time_high_us(data: Any) -> int | None:
    """Sensor time (us, modulo 2^24) of the first TIME_HIGH word, ``None`` when there is none."""
    view = memoryview(data).cast("B")
    words = np.frombuffer(view[: len(view) & ~1], dtype="<u2")
    found = np.flatnonzero(words >> 12 == _TIME_HIGH)
    return int(words[found[0]] & 0xFFF) << 12 if found.size else None


class PacketStream:
    """Drives a ``Reconstructor`` over packets whose clock and modulation arrive separately.

    Packets are held, in order and bounded, until the modulation and the clock are known. The
    clock is exact when the camera announces its zero; when nobody does so within
    ``clock_timeout_s`` it is estimated from the packets' stamps, and the modulation's phase is
    then taken from the events (or triggers), since the estimate is not good to a microsecond.

    The decoder counts time from the last wrap of the stream's 24-bit time before it started. A
    stream joined later than its first packet, or after more than half a wrap without packets, is
    brought to the announced zero by the packets' stamps.

    Parameters
    ----------
    calibration : Calibration
    settings : Settings
    clock_timeout_s : float
    held_max : int
        Packets held while clock or modulation are unknown; further ones count as lost.

    Attributes
    ----------
    packets, packets_lost, restarts : int
        Packets reconstructed, missing by their ``seq``, and new starts of the stream.
    """

    def __init__(
        self,
        calibration: Calibration,
        settings: Settings,
        clock_timeout_s: float,
        held_max: int = 1000,
    ) -> None:
        self.calibration = calibration
        self.packets = 0
        self.packets_lost = 0
        self.restarts = 0
        self._settings = settings
        self._clock_timeout_s = clock_timeout_s
        self._held: deque[Packet] = deque()
        self._held_max = held_max
        self._held_since_s: float | None = None
        self._clock: SensorClock | None = None
        self._announced = False
        self._clock_used = False
        self._laser: tuple[Modulation, int | None] | None = None
        self._reconstructor: Reconstructor | None = None
        self._wraps = 0
        self._next_seq: int | None = None
        self._last_stamp_ns = 0
        self._retired: Counter[str] = Counter()
        self._out: list[TimedProfiles] = []

    @property
    def held(self) -> int:
        """Packets that wait for clock or modulation."""
        return len(self._held)

    @property
    def waits_for(self) -> str:
        """What the held packets wait for, empty when nothing."""
        if self._laser is None:
            return "modulation"
        return "camera clock" if self._clock is None else ""

    @property
    def clock_announced(self) -> bool:
        """Whether times come from the camera's announcement (exact)."""
        return self._announced

    @property
    def clock_residual_ns(self) -> int | None:
        """How much later than its sensor time the newest packet arrived."""
        return self._clock.residual_ns if self._clock is not None else None

    @property
    def processed_until_ns(self) -> int | None:
        """ROS time up to which the stream has been reconstructed."""
        newest_us = self._reconstructor.time_us if self._reconstructor is not None else None
        if newest_us is None or self._clock is None:
            return None
        return self._clock.to_ns(newest_us + self._wraps * WRAP_US)

    @property
    def counters(self) -> Counter[str]:
        """Counters of all reconstructors so far, summed by name."""
        total = Counter(self._retired)
        if self._reconstructor is not None:
            total.update(self._reconstructor.counters)
        return total

    def announce_zero(self, zero_ns: int) -> None:
        """Take the camera's word that its sensor time 0 was ROS time ``zero_ns``."""
        if self._announced and self._clock is not None and self._clock.zero_ns == zero_ns:
            self._clock_used = False
            return
        self._retire()
        self._clock = SensorClock(zero_ns)
        self._announced = True
        self._clock_used = False

    def set_laser(self, modulation: Modulation, epoch_ns: int | None) -> None:
        """Use this modulation and ROS time of one rising edge for packets processed later."""
        if (modulation, epoch_ns) == self._laser:
            return
        self._laser = modulation, epoch_ns
        if self._reconstructor is not None:
            self._reconstructor.set_modulation(self._modulation())
            self._collect(Profiles.empty())

    def set_settings(self, settings: Settings) -> None:
        """Use ``settings`` for packets processed later; the open period is closed first."""
        if settings == self._settings:
            return
        self._settings = settings
        self._renew()

    def set_calibration(self, calibration: Calibration) -> None:
        """Use ``calibration`` for packets processed later; the open period is closed first."""
        self.calibration = calibration
        self._renew()

    def add(self, packet: Packet, now_s: float) -> None:
        """Queue one packet that arrived at steady time ``now_s``."""
        if self._held_since_s is None:
            self._held_since_s = now_s
        if len(self._held) < self._held_max:
            self._held.append(packet)

    def process(self, now_s: float) -> list[TimedProfiles]:
        """Reconstruct what can be; returns the profiles completed since the last call."""
        while self._held:
            if self._restarted(self._held[0]):
                self._forget_stream()
            if not self._ready(self._held[0], now_s):
                break
            self._push(self._held.popleft())
            self._held_since_s = now_s
        if not self._held:
            self._held_since_s = None
        return self._take()

    def flush(self) -> list[TimedProfiles]:
        """Close the open period."""
        if self._reconstructor is not None:
            self._collect(self._reconstructor.flush())
        return self._take()

    def _restarted(self, packet: Packet) -> bool:
        return self._next_seq is not None and packet.seq < self._next_seq

    def _forget_stream(self) -> None:
        self._retire()
        self.restarts += 1
        self._next_seq = None
        if self._clock_used:
            self._clock = None
            self._announced = False

    def _ready(self, packet: Packet, now_s: float) -> bool:
        if self._laser is None:
            return False
        if self._clock is None:
            since_s = now_s - (self._held_since_s if self._held_since_s is not None else now_s)
            if since_s < self._clock_timeout_s:
                return False
            self._clock = SensorClock()
            self._clock.observe(first_time_high_us(packet.data) or 0, packet.stamp_ns)
        return True

    def _push(self, packet: Packet) -> None:
        assert self._clock is not None
        missing = 0 if self._next_seq is None else packet.seq - self._next_seq
        self.packets_lost += missing
        if missing and packet.stamp_ns - self._last_stamp_ns > _GAP_NS:
            self._retire()
        high_us = first_time_high_us(packet.data)
        if self._reconstructor is None:
            self._wraps = self._missed_wraps(packet, high_us)
            self._reconstructor = Reconstructor(
                self.calibration, self._modulation(), self._settings
            )
        elif missing:
            self._reconstructor.note_gap()
        before_us = self._reconstructor.time_us
        self._collect(self._reconstructor.push(packet.data))
        if high_us is not None:
            turns = round(((before_us if before_us is not None else high_us) - high_us) / WRAP_US)
            self._clock.observe(high_us + (turns + self._wraps) * WRAP_US, packet.stamp_ns)
        self._next_seq = packet.seq + 1
        self._last_stamp_ns = packet.stamp_ns
        self._clock_used = True
        self.packets += 1

    def _missed_wraps(self, packet: Packet, high_us: int | None) -> int:
        """Count the wraps before this packet that a fresh decoder does not know of."""
        if packet.seq == 0 or not self._announced or high_us is None:
            return 0
        assert self._clock is not None
        known_ns = self._last_stamp_ns if self._resumes(packet) else packet.stamp_ns
        return max(round((self._clock.to_us(known_ns) - high_us) / WRAP_US), 0)

    def _resumes(self, packet: Packet) -> bool:
        """Whether the stream's own time, better than a stamp, says where this packet belongs."""
        return self._next_seq == packet.seq

    def _modulation(self) -> Modulation:
        assert self._laser is not None
        modulation, epoch_ns = self._laser
        if epoch_ns is None or not self._announced or self._clock is None:
            return modulation
        return replace(modulation, on_edge_us=self._clock.to_us(epoch_ns) - self._wraps * WRAP_US)

    def _renew(self) -> None:
        """End the reconstructor; the next one goes on where it stopped."""
        until_ns = self.processed_until_ns
        if self._reconstructor is not None:
            self._retire()
            self._last_stamp_ns = until_ns or self._last_stamp_ns

    def _retire(self) -> None:
        """Close the open period and keep the counters of the reconstructor that ends here."""
        if self._reconstructor is None:
            return
        self._collect(self._reconstructor.flush())
        self._retired.update(self._reconstructor.counters)
        self._reconstructor = None

    def _collect(self, profiles: Profiles) -> None:
        if not len(profiles):
            return
        assert self._clock is not None
        shift_us = self._wraps * WRAP_US
        self._out.append(
            TimedProfiles(
                profiles,
                self._clock.to_ns(profiles.t_us + shift_us),
                self._clock.to_ns(profiles.edge_us + shift_us),
            )
        )

    def _take(self) -> list[TimedProfiles]:
        out, self._out = self._out, []
        return out
