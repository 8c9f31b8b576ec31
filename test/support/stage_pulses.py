"""A stage that gives pulses to a camera with a drifting clock; the truth is known."""

from itertools import pairwise

import numpy as np

from eschorty_ros.core.clocks import ClockLine, PulseTrain, StageTrack, plan_move

SEED = 21
EPOCH_NS = 1_760_000_000_123_456_789
PULSES = PulseTrain(1.0, 2.0, 110)
DRIFT = 50e-6


class StagePulses:
    """Sweeps of a stage, its odometry at 100 Hz, and the edges in sensor time."""

    def __init__(
        self,
        targets=(10.0, 210.0),
        speed=300.0,
        acceleration=5000.0,
        pulses=PULSES,
        missing=0.001,
        spurious=0,
        sampling_us=102.0,
        odometry_mm=0.0,
        seed=SEED,
        width_us=500,
        lead_s=1.0,
        drift=DRIFT,
    ):
        rng = np.random.default_rng(seed)
        self.track = StageTrack(max_gap_us=500_000)
        self.true = ClockLine(0, EPOCH_NS, round(drift * 1e9))
        crossings, plans = [], []
        now = EPOCH_NS + round(lead_s * 1e9)
        for start, stop in pairwise(targets):
            plan = plan_move(now, start, stop, speed, acceleration)
            plans.append(plan)
            until = now + round(sum(plan.durations_s) * 1e9)
            t = now + np.arange(0, until - now, 20_000)
            x = plan.state(t)[0]
            n = np.floor((x - pulses.first_mm) / pulses.interval_mm)
            for k in np.flatnonzero(np.diff(n)):
                if 0 <= max(n[k], n[k + 1]) < pulses.count:
                    crossings.append(int(t[k]) + 10_000)
            now = until + 300_000_000
        self.plans, self.until_ns = plans, now
        t = np.arange(EPOCH_NS, now, 10_000_000)
        self.track.append(t // 1000, self.position(t) + rng.normal(0.0, odometry_mm, t.size))
        at = np.array(crossings) + np.rint(rng.uniform(0.0, sampling_us, len(crossings)) * 1e3)
        kept = rng.random(at.size) >= missing
        self.missing = int((~kept).sum())
        at = at[kept].astype(np.int64)
        if spurious:
            at = np.sort(np.concatenate([at, rng.integers(plans[0].start_ns, now, spurious)]))
        self.edges = np.asarray(self.true.to_us(at))
        self.falls = self.edges + width_us

    def position(self, t_ns):
        position = np.full(t_ns.shape, self.plans[0].position_mm)
        for plan in self.plans:
            position = np.where(t_ns >= plan.start_ns, plan.state(t_ns)[0], position)
        return position

    def arrivals(self, late_ms=0.0, drift_ppm=50.0):
        """Return the clock by arrivals that are late."""
        middle = int(self.edges[self.edges.size // 2])
        return ClockLine(middle, self.true.to_ns(middle) + round(late_ms * 1e6),
                         round(drift_ppm * 1e3))  # fmt: skip

    def error_um(self, fit):
        """Return the largest error of a position at 300 mm/s over the time of the edges."""
        t = np.linspace(self.edges[0], self.edges[-1], 1000).astype(np.int64)
        return float(np.abs(fit.line.to_ns(t) - self.true.to_ns(t)).max()) * 300e-6
