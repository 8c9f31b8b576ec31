"""Physics between the emulated devices: laser and stage light the scene, the sensor measures it.

Laser and stage act in bench time, int64 nanoseconds of the bench's clock. The sensor has a clock of
its own, which starts at 0 with every start of the stream and may run fast or slow. The world is
simulated on demand, never beyond the bench's present: on a slow machine the same bytes come later,
with their lateness, so that a host can stamp them as if they had come in time.
"""

from __future__ import annotations

import random
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.numbers import number
from eschorty_ros.core.clocks import MotionPlan
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.simulation.world import SensorControl, World

TRIGGERS = ("none", "laser", "stage")

Pulses = Callable[[int, int], list[tuple[int, bool]]]
"""Edges of the stage's trigger output from one bench time (ns) to before another: time, rising."""

_PACKET_US = 4_000
# Shorter packets leave together.
_PACKET_MIN_US = 1_000
_AT_ONCE_US = 16_000
# Those of a dark scene leave together, too.
_DARK_US = 32_000
# Sensor time of the first simulation after a change, and time that later ones may take: reads
# of a camera whose bench is late are not held up.
_FIRST_US = 200
_BUSY_S = 0.05
_SLEEP_MIN_S = 1e-4
_PULSE_MAX_NS = 1_000_000_000
_PPB = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Imperfections:
    """Deviations of the bench from an ideal one.

    Raises ``ArgumentError`` for a value outside its range.
    """

    sensor_ppm: float = 0.0
    generator_ppm: float = 0.0
    """Rate error of the sensor's and the generator's clock."""
    usb_jitter_ms: float = 0.0
    """Largest delay of the camera's bytes, uniformly distributed from 0."""
    missing_edges: float = 0.0
    """Share of the trigger edges that the camera misses."""
    seed: int = 0
    """Seed of jitter and missing edges."""

    def __post_init__(self) -> None:
        for name, low, high in (
            ("sensor_ppm", -1000.0, 1000.0),
            ("generator_ppm", -1000.0, 1000.0),
            ("usb_jitter_ms", 0.0, 1000.0),
            ("missing_edges", 0.0, 1.0),
        ):
            number(name, getattr(self, name), low, high)

    @property
    def sensor_rate(self) -> Fraction:
        """Return sensor time per bench time."""
        return 1 + Fraction(round(self.sensor_ppm * 1000), _PPB)

    @property
    def generator_rate(self) -> Fraction:
        """Return generator time per bench time."""
        return 1 + Fraction(round(self.generator_ppm * 1000), _PPB)


@dataclass(frozen=True, slots=True)
class _Light:
    since_ns: int
    on: bool
    modulation: Modulation | None


@dataclass(frozen=True, slots=True)
class _Control:
    since_ns: int
    control: SensorControl


class Physics:
    """Scene, laser and stage before the sensor; the source of the camera's bytes.

    A caller that makes a device act holds ``lock`` from reading the bench's clock until it has
    called ``set_laser``, ``set_stage`` or ``set_sensor``, and calls :meth:`collect_pulses` before:
    every change is then set before the world reaches its time. The camera calls ``read``, ``start``
    and ``stop``.

    - ``make_world``: Makes a new world for each start of the stream.
    - ``clock_ns``: The bench's clock.
    - ``trigger``: Output that is wired to the camera's trigger input: ``none``, ``laser`` or
      ``stage``.
    - ``pulses``: The stage's trigger output.

    Public attributes:
    - ``packet_us``: Sensor time after which a packet of bytes leaves, at least a millisecond.
    - ``late_ns``: Bench time between the end of the bytes simulated last and their simulation.
    - ``late_changes``: Changes set after the world had passed their time.
    - ``edges``, ``edges_missed``: Trigger edges on the wire, and those of them that the camera
      misses.

    Raises ``ArgumentError`` for an unknown ``trigger``.
    """

    def __init__(
        self,
        make_world: Callable[[], World],
        clock_ns: Callable[[], int],
        imperfections: Imperfections | None = None,
        trigger: str = "none",
        pulses: Pulses | None = None,
    ) -> None:
        if trigger not in TRIGGERS:
            raise ArgumentError(f"trigger is {trigger!r}; choose one of {', '.join(TRIGGERS)}")
        self.lock = threading.RLock()
        self.clock_ns = clock_ns
        self.packet_us = _PACKET_US
        self.late_ns = 0
        self.late_changes = 0
        self.edges = 0
        self.edges_missed = 0
        self._make_world = make_world
        self._imperfections = imperfections or Imperfections()
        self._trigger = trigger
        self._pulses = pulses
        self._edge_chance = random.Random(self._imperfections.seed)
        self._usb_chance = random.Random(self._imperfections.seed + 1)
        self._simulating = threading.Lock()
        self._world: World | None = None
        self._zero_ns = 0
        self._light = _Light(clock_ns(), False, None)
        self._plan = MotionPlan(clock_ns(), 0.0)
        self._control = _Control(clock_ns(), SensorControl())
        self._changes: deque[_Light | MotionPlan | _Control] = deque()
        self._stage_edges: deque[tuple[int, bool]] = deque()
        self._collected_ns = 0
        self._in_transit: deque[tuple[int, bytes]] = deque()
        self._packet = self._rest = b""
        self._packet_end_us = 0
        self._at_once_us = _FIRST_US
        self._running = threading.Event()

    def set_laser(self, since_ns: int, on: bool, modulation: Modulation | None) -> None:
        """Set the laser's output from ``since_ns`` on, the time of a rising edge."""
        with self.lock:
            self._light = _Light(since_ns, on, modulation)
            self._changes.append(self._light)

    def set_stage(self, plan: MotionPlan) -> None:
        """Set the carriage's motion from the start of ``plan`` on."""
        with self.lock:
            self._plan = plan
            self._changes.append(plan)

    def set_sensor(self, control: SensorControl) -> None:
        """Set the sensor from now on."""
        with self.lock:
            self._control = _Control(self.clock_ns(), control)
            self._changes.append(self._control)

    def collect_pulses(self) -> None:
        """Collect the stage's trigger edges up to now, before a command changes later ones."""
        if self._trigger != "stage" or self._pulses is None:
            return
        with self.lock:
            now_ns = self.clock_ns()
            if now_ns <= self._collected_ns:
                return
            # This runs with every packet: skip a carriage at rest, which gives no pulses.
            if self._collected_ns <= self._plan.end_ns + _PULSE_MAX_NS:
                self._stage_edges.extend(self._pulses(self._collected_ns, now_ns))
            self._collected_ns = now_ns

    def start(self) -> None:
        """Start streaming; the sensor's clock starts at 0."""
        # Outside the lock: laser and stage go on while the world is made.
        world = self._make_world()
        with self._simulating, self.lock:
            self.collect_pulses()
            self._stage_edges.clear()
            self._changes.clear()
            self._zero_ns = self._collected_ns = self.clock_ns()
            self._world = world
            if self._trigger == "laser":
                world.trigger_input = lambda a, b: self._received(world.laser_edges(a, b))
            elif self._trigger == "stage":
                world.trigger_input = self._stage_trigger
            self._apply_light(world, self._light)
            self._apply_plan(world, self._plan)
            world.set_sensor(0, self._control.control)
            self._in_transit.clear()
            self._packet = self._rest = b""
            self._packet_end_us = 0
            self._at_once_us = _FIRST_US
            self._running.set()

    def stop(self) -> None:
        """Stop streaming; a waiting ``read`` returns; idempotent."""
        self._running.clear()

    def read(self, max_bytes: int, timeout_s: float) -> bytes:
        """Return the packets sent by now, ``b""`` when none come in ``timeout_s``."""
        deadline_s = time.monotonic() + timeout_s
        while True:
            with self._simulating:
                if self._running.is_set():
                    begun_s = time.monotonic()
                    while self._simulate() and not self._in_transit:
                        if time.monotonic() > max(deadline_s, begun_s + _BUSY_S):
                            break
                    self._deliver()
                data, self._rest = self._rest[:max_bytes], self._rest[max_bytes:]
            left_s = deadline_s - time.monotonic()
            if data or left_s <= 0.0 or not self._running.is_set():
                return data
            time.sleep(min(self._next_packet_s(), left_s))

    def statistics(self) -> dict[str, float]:
        """Return counts of events, dropped events, late changes and trigger edges, and the lag."""
        world = self._world
        behind_ns = 0
        if world is not None and self._running.is_set():
            behind_ns = self.clock_ns() - self._zero_ns - self._bench_ns(world.now_us)
        return {
            "events": float(world.events if world is not None else 0),
            "rate_dropped": float(world.rate_dropped if world is not None else 0),
            "behind_s": behind_ns * 1e-9,
            "late_changes": float(self.late_changes),
            "trigger_edges": float(self.edges),
            "trigger_edges_missed": float(self.edges_missed),
        }

    def _next_packet_s(self) -> float:
        """Return the time until the next packet leaves or arrives."""
        world = self._world
        if world is None or not self._running.is_set():
            return _PACKET_MIN_US * 1e-6
        due_ns = self._zero_ns + self._bench_ns(self._packet_end_us + self._step_us(world))
        if self._in_transit:
            due_ns = min(due_ns, self._in_transit[0][0])
        return max(due_ns - self.clock_ns(), 0) * 1e-9 + _SLEEP_MIN_S

    def _step_us(self, world: World) -> int:
        dark = not self._light.on and self._sensor_us(self._light.since_ns) <= world.now_us
        return max(self.packet_us, _DARK_US if dark else _PACKET_MIN_US)

    def _simulate(self) -> bool:
        """Advance the world by some packets, or part of one; returns whether it advanced."""
        world = self._world
        assert world is not None
        with self.lock:
            self.collect_pulses()
            horizon_ns = self.clock_ns()
            changes = list(self._changes)
            self._changes.clear()
        if changes:
            self._at_once_us = _FIRST_US
        for change in changes:
            if isinstance(change, _Light):
                self._apply_light(world, change)
            elif isinstance(change, _Control):
                world.set_sensor(self._from_us(world, change.since_ns), change.control)
            else:
                self._apply_plan(world, change)
        if world.now_us == self._packet_end_us:
            step_us = self._step_us(world)
            packets = (self._sensor_us(horizon_ns) - world.now_us) // step_us
            if packets < 1:
                return False
            self._packet_end_us += min(packets, max(self._at_once_us // step_us, 1)) * step_us
        begun_s, from_us = time.monotonic(), world.now_us
        self._packet += world.advance(min(from_us + self._at_once_us, self._packet_end_us))
        pace_us = (world.now_us - from_us) / max(time.monotonic() - begun_s, 1e-6)
        at_once_us = min(round(_BUSY_S * pace_us), 2 * self._at_once_us, _AT_ONCE_US)
        self._at_once_us = max(at_once_us, _FIRST_US)
        self.late_ns = self.clock_ns() - self._zero_ns - self._bench_ns(world.now_us)
        if self._packet and world.now_us == self._packet_end_us:
            late_ns = round(self._usb_chance.uniform(0.0, self._imperfections.usb_jitter_ms) * 1e6)
            self._in_transit.append((horizon_ns + late_ns, self._packet))
            self._packet = b""
        return True

    def _deliver(self) -> None:
        """Deliver the bytes that have arrived, in the order of sending."""
        while self._in_transit and self._in_transit[0][0] <= self.clock_ns():
            self._rest += self._in_transit.popleft()[1]

    def _apply_light(self, world: World, light: _Light) -> None:
        since_us = self._from_us(world, light.since_ns)
        if not light.on or light.modulation is None:
            world.set_laser(since_us, False)
            return
        wave = replace(light.modulation, on_edge_us=self._sensor_us(light.since_ns))
        rate = self._imperfections.sensor_rate / self._imperfections.generator_rate
        world.set_laser(since_us, True, wave, rate)

    def _apply_plan(self, world: World, plan: MotionPlan) -> None:
        since_us = self._from_us(world, plan.start_ns)
        world.set_stage(plan, self._zero_ns, since_us, self._imperfections.sensor_rate)

    def _stage_trigger(self, begin_us: int, end_us: int) -> list[tuple[int, bool]]:
        edges = []
        while self._stage_edges and self._sensor_us(self._stage_edges[0][0]) < end_us:
            t_ns, rising = self._stage_edges.popleft()
            edges.append((max(self._sensor_us(t_ns), begin_us), rising))
        return self._received(edges)

    def _received(self, edges: list[tuple[int, bool]]) -> list[tuple[int, bool]]:
        """Return the edges without those that the camera misses."""
        missing = self._imperfections.missing_edges
        received = [edge for edge in edges if self._edge_chance.random() >= missing]
        self.edges += len(edges)
        self.edges_missed += len(edges) - len(received)
        return received

    def _from_us(self, world: World, t_ns: int) -> int:
        """Return the sensor time of ``t_ns``, not before the world's; counts late changes."""
        t_us = self._sensor_us(t_ns)
        if t_us < world.now_us and world.now_us > 0:
            self.late_changes += 1
        return max(t_us, world.now_us)

    def _sensor_us(self, t_ns: int) -> int:
        rate = self._imperfections.sensor_rate
        return (t_ns - self._zero_ns) * rate.numerator // (rate.denominator * 1000)

    def _bench_ns(self, t_us: int) -> int:
        rate = self._imperfections.sensor_rate
        return t_us * 1000 * rate.denominator // rate.numerator
