"""Scene, laser, stage and pixels joined over sensor time: EVT3 bytes out, with the truth known."""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.clocks import MotionPlan
from eschorty_ros.core.evt3 import Encoder
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import Calibration
from eschorty_ros.simulation.pixels import (
    PixelArray,
    PixelParameters,
    parameters_from_biases,
    unpack,
)
from eschorty_ros.simulation.readout import Readout, ReadoutParameters
from eschorty_ros.simulation.scenes import Scene
from eschorty_ros.simulation.world.drawn_line import DrawnLine
from eschorty_ros.simulation.world.effects import Effects
from eschorty_ros.simulation.world.timeline import (
    LaserTimeline,
    SensorControl,
    StageTimeline,
    Timeline,
)
from eschorty_ros.simulation.world.truth_log import TruthLog

BACKGROUND_HZ = 0.22
"""Background activity per pixel: 5 % of all events at 70 Hz with every column lit."""

STEP_MM = 0.25
"""Stage travel after which a moving line is drawn again."""

_STEP_MAX_US = 5_000
_STEP_MIN_US = 50
_PIECE_US = 65_536

EdgeSource = Callable[[int, int], list[tuple[int, bool]]]
"""Edges from one sensor time (us) to before another: time, rising; in order of time."""
_TIME_HIGH_US = 4_096


class World:
    """A camera in front of a scene, with laser and stage.

    The bytes depend on scene, calibration, parameters, seed and the settings of laser and stage,
    not on the spacing of calls to :meth:`advance`.

    - ``parameters``: Pixels under the factory's biases.
    - ``seed``: Fixes thresholds, jitter and background.
    - ``background_hz``: Background events per pixel and second.
    - ``readout``: Replaces that of ``effects``.

    Public attributes:
    - ``trigger_input``: Source of edges at the camera's trigger input; called once for every piece
      of time.
    """

    def __init__(
        self,
        scene: Scene,
        calibration: Calibration,
        parameters: PixelParameters | None = None,
        seed: int = 0,
        background_hz: float = BACKGROUND_HZ,
        readout: ReadoutParameters | None = None,
        effects: Effects | None = None,
    ) -> None:
        effects = effects or Effects()
        self.model = calibration.model()
        self.columns = self.model.columns
        self.rows = self.model.rows
        self.events = 0
        self.trigger_input: EdgeSource | None = None
        parameters = parameters or PixelParameters()
        self._factory = effects.pixels(parameters, self.model)
        background_hz *= self._factory.background_intensity / parameters.background_intensity
        self._pixels = PixelArray(self.columns, self.rows, self._factory, seed, background_hz)
        readout = readout or ReadoutParameters(effects.row_time_us)
        self._readout = Readout(self.rows, readout)
        self._encoder = Encoder(self.columns, self.rows)
        self._laser = LaserTimeline()
        self._stage = StageTimeline()
        self._control = SensorControl()
        self._controls: Timeline[SensorControl] = Timeline()
        seen = effects.scene(scene, self.model)
        self._truth = TruthLog(seen, self.model)
        self._line = DrawnLine(seen, calibration, self._pixels, effects)
        self._now_us = 0
        self._handled_us = -1
        self._lit_since_us: int | None = None
        self._step_us: int | None = None

    @property
    def now_us(self) -> int:
        """Sensor time simulated so far."""
        return self._now_us

    @property
    def dropped(self) -> int:
        """Events lost so far because the readout was full; the stream has only their times."""
        return self._readout.dropped

    @property
    def rate_dropped(self) -> int:
        """Events the event-rate control has dropped so far; the stream reports them."""
        return self._readout.rate_dropped

    def set_laser(
        self,
        t_us: int,
        on: bool,
        modulation: Modulation | None = None,
        clock_rate: Fraction = Fraction(1),
    ) -> None:
        """Switch the laser from ``t_us`` on; ``modulation.on_edge_us`` sets the phase.

        Replaces settings of later times. ``clock_rate`` is the sensor time that passes per
        unit of the generator's time.

        Raises ``ArgumentError`` when ``t_us`` has been simulated already, or the modulation's edge
        is unknown.
        """
        self._refuse_past("t_us", t_us)
        self._laser.set(t_us, on, modulation, clock_rate)

    def set_stage(
        self,
        plan: MotionPlan,
        zero_ns: int = 0,
        from_us: int | None = None,
        clock_rate: Fraction = Fraction(1),
    ) -> None:
        """Follow ``plan``, whose clock read ``zero_ns`` at sensor time 0.

        The plan holds from its own start on, or from ``from_us``; before the first plan the
        stage rests at 0 mm. ``clock_rate`` is the sensor time that passes per unit of the plan's.

        Raises ``ArgumentError`` when that time has been simulated already.
        """
        since_zero = (plan.start_ns - zero_ns) * clock_rate / 1000
        start_us = math.ceil(since_zero) if from_us is None else from_us
        self._refuse_past("the plan's start", start_us)
        self._stage.set(start_us, plan, zero_ns, clock_rate)

    def set_sensor(self, t_us: int, control: SensorControl) -> None:
        """Run the sensor under ``control`` from ``t_us`` on; replaces settings of later times.

        Raises ``ArgumentError`` when ``t_us`` has been simulated already.
        """
        self._refuse_past("t_us", t_us)
        self._controls.add(t_us, control)

    def laser_edges(self, begin_us: int, end_us: int) -> list[tuple[int, bool]]:
        """Return the edges of the laser's gate signal, an ``EdgeSource``."""
        return self._laser.edges(begin_us, end_us)

    def stage_mm(self, t_us: int) -> float:
        """Return the stage position at sensor time ``t_us`` as planned now."""
        return self._stage.state(t_us)[0]

    def advance(self, until_us: int) -> bytes:
        """Return the EVT3 bytes of all events read out up to ``until_us`` since the last call.

        Raises ``ArgumentError`` when ``until_us`` has been simulated already.
        """
        self._refuse_past("until_us", until_us)
        parts = []
        while self._now_us < until_us:
            self._use(self._controls.at(self._now_us) or self._control)
            end_us = min(until_us, self._now_us + _PIECE_US)
            change_us = self._controls.next_us(self._now_us)
            if change_us is not None:
                end_us = min(end_us, change_us)
            self._apply_light(end_us)
            self._pixels.run_until(end_us)
            keys, drops_us, periods = self._readout.read_out(self._pixels.take(end_us), end_us)
            if self._encoder.time_us is None:
                parts.append(self._encoder.advance(0))
            self.events += keys.size
            triggers = self.trigger_input(self._now_us, end_us) if self.trigger_input else []
            parts.append(
                self._encoder.encode(
                    *unpack(keys),
                    trigger_t=[t_us for t_us, _ in triggers],
                    trigger_edge=[int(rising) for _, rising in triggers],
                    drop_t=drops_us,
                    rate_counts=periods,
                )
            )
            # Only multiples of TIME_HIGH: the bytes must not depend on the spacing of calls.
            step_us = end_us - end_us % _TIME_HIGH_US
            if step_us > (self._encoder.time_us or 0):
                parts.append(self._encoder.advance(step_us))
            self._now_us = end_us
            self._laser.drop_before(self._handled_us)
            self._stage.drop_before(self._handled_us)
            self._controls.drop_before(self._now_us)
        return b"".join(parts)

    @property
    def truth(self) -> NDArray[np.void]:
        """True range per modulation period and lit column, TRUTH_DTYPE, in time order.

        ``t_us`` is the middle of the lit phase; a column counts as lit when its line falls on
        the sensor. The last million periods are kept.
        """
        return self._truth.table()

    def _refuse_past(self, name: str, t_us: int) -> None:
        if t_us < self._now_us:
            raise ArgumentError(
                f"{name} is {t_us} us and {self._now_us} us are simulated; give a later time"
            )

    def _use(self, control: SensorControl) -> None:
        before, self._control = self._control, control
        if control.event_rate != before.event_rate:
            self._readout.limit(self._now_us, control.event_rate)
        if control.biases != before.biases:
            pixels = parameters_from_biases(self._factory, control.biases)
            self._pixels.change(self._now_us, pixels)
            self._line.redraw()
            if self._lit_since_us is not None:
                self._step_us = self._now_us

    def _apply_light(self, end_us: int) -> None:
        """Apply every change of light before ``end_us``."""
        while True:
            candidates = [self._laser.next_us(self._handled_us), self._step_us]
            t_us = min((t for t in candidates if t is not None), default=end_us)
            if t_us >= end_us:
                return
            self._handled_us = t_us
            level = self._laser.level(t_us)
            if self._lit_since_us is not None and self._laser.rises(t_us):
                # Light that stays on: the next period begins.
                self._close_phase(t_us)
            if level > 0.0:
                self._draw(t_us, level)
            elif self._lit_since_us is not None:
                self._remove(t_us)

    def _draw(self, t_us: int, level: float) -> None:
        """Draw the line on the scene where the stage is in the middle of the time to the next draw.

        The first draw after an edge lasts half as long, as pixels answer to the light of then.
        """
        position_mm, velocity_mm_s = self._stage.state(t_us)
        pace_us = STEP_MM / max(abs(velocity_mm_s), 1e-9) * 1e6
        pace_us = min(max(pace_us, _STEP_MIN_US), _STEP_MAX_US)
        if self._lit_since_us is None:
            self._lit_since_us = t_us
            pace_us *= 0.5
        self._step_us = t_us + int(pace_us)
        end_us = self._laser.next_us(t_us)
        end_us = self._step_us if end_us is None else min(end_us, self._step_us)
        self._line.draw(t_us, position_mm + velocity_mm_s * 0.5e-6 * (end_us - t_us), level)

    def _remove(self, t_us: int) -> None:
        """Remove the line and log the phase that ends here, unless switching off has cut it."""
        self._line.remove(t_us)
        if self._laser.ends_period(t_us):
            self._close_phase(t_us)
        self._lit_since_us = None
        self._step_us = None

    def _close_phase(self, t_us: int) -> None:
        """Log the lit phase that ends here."""
        middle_us = ((self._lit_since_us or 0) + t_us) // 2
        self._truth.add(middle_us, self._stage.state(middle_us)[0])
        self._lit_since_us = t_us
