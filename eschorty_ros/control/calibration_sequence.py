"""The steps of a capture for a calibration: on every way out the laser goes off."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from eschorty_ros.control.scan_sequence import (
    End,
    Instrument,
    Outcome,
    check_laser,
    check_sweep,
    end_light,
)
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.numbers import short
from eschorty_ros.core.calibration import METHODS
from eschorty_ros.live.calibration_capture import CaptureRequest

CAPTURE_MAX_S = 120.0
_DRAIN_S = 10.0
_DRAIN_WITHIN_S = 120.0
_APPROACH_MM_S = 100.0


class CaptureInstrument(Instrument, Protocol):
    """Instrument for a capture, which lasts for a given time."""

    def collect(self, duration_s: float) -> None:
        """Wait until the reconstruction has passed this much sensor time."""


def check_request(request: CaptureRequest) -> None:
    """Raise ``ArgumentError`` with name, value and remedy unless the capture can be done.

    `run_capture` checks the sweep, by the stage's limits.
    """
    if request.method not in METHODS:
        raise ArgumentError(
            f"method is {short(request.method)}; choose one of {', '.join(METHODS)}"
        )
    check_laser(request.frequency_hz, request.duty)
    sweep = request.sweep
    if sweep is None:
        if len(request.targets) < 2:
            raise ArgumentError(
                f"targets holds {len(request.targets)}; give two or more, or sweep_speed for one "
                "that the stage moves"
            )
        if not 0.0 < request.capture_s <= CAPTURE_MAX_S:
            raise ArgumentError(
                f"capture_time is {request.capture_s:g} s; choose more than 0 and at most "
                f"{CAPTURE_MAX_S:g} s"
            )
        return
    if len(request.targets) != 1:
        raise ArgumentError(
            f"targets holds {len(request.targets)}; with sweep_speed give the one that moves"
        )
    if not 0.0 < abs(sweep.range_per_stage) <= 1.0:
        raise ArgumentError(
            f"range_per_stage is {sweep.range_per_stage:g}; choose -1 to 1 and not 0"
        )


def run_capture(
    instrument: CaptureInstrument,
    request: CaptureRequest,
    begin: Callable[[], None],
    finish: Callable[[], None],
) -> Outcome:
    """Do one capture; raise no ``EschortyError``, leave the laser off and the stage at rest.

    ``begin`` and ``finish`` start and end the collection of events; ``finish`` runs whenever
    ``begin`` returned.
    """
    outcome = Outcome()
    collecting = False
    sweep = request.sweep
    try:
        with outcome.steps():
            instrument.report("preparing")
            # First, because it fails while a scan is under way.
            begin()
            collecting = True
            instrument.check_nodes()
            instrument.configure_laser(request.frequency_hz, request.duty)
            if sweep is not None:
                limits = instrument.stage_limits()
                check_sweep(
                    sweep.start_mm, sweep.stop_mm, sweep.speed_mm_s, limits, prefix="sweep_"
                )
                instrument.move(sweep.start_mm, min(_APPROACH_MM_S, sweep.speed_mm_s))
            instrument.laser_on()
            instrument.watch(True)
            instrument.report("capturing")
            if sweep is None:
                instrument.collect(request.capture_s)
            else:
                instrument.move(sweep.stop_mm, sweep.speed_mm_s)
                instrument.move(sweep.start_mm, sweep.speed_mm_s)
    finally:
        end_light(instrument, outcome)
        if outcome.end is End.SUCCEEDED:
            instrument.report("finishing")
            outcome.attempt(lambda: instrument.drain(_DRAIN_S, _DRAIN_WITHIN_S))
        if collecting:
            outcome.attempt(finish)
    return outcome
