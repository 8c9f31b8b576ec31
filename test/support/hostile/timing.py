"""Clocks, motion, modulation and its phase."""

from __future__ import annotations

from functools import partial

import numpy as np

from eschorty_ros.core.clocks import (
    clock_line,
    edge_clock,
    edge_fit,
    lower_envelope,
    motion,
    motion_fit,
    pulses,
    sensor_clock,
    stage_track,
)
from eschorty_ros.core.modulation import (
    modulation,
    phase_estimate,
    phase_gate,
)
from hostile.kinds import (
    Call,
    Kind,
    integers,
    number,
    reals,
    text,
    vector,
    whole,
)
from hostile.subjects import (
    LASER,
    POLARITY,
    SIGNS,
    T_MAX,
    TIMES,
    N,
    method,
)


def a_track() -> stage_track.StageTrack:
    track = stage_track.StageTrack()
    track.append([0, 10], [0.0, 1.0])
    return track


PULSES = pulses.PulseTrain(0.0, 2.0, 3)


def a_fit() -> motion_fit.MotionFit:
    fit = motion_fit.MotionFit()
    fit.add_reading(0.0, 10, 5)
    fit.expect_move(motion.plan_move(20, 0.0, 5.0, 1.0, 1.0))
    return fit


CALLS: dict[str, Call] = {
    "stage_track.quantise_nm": Call(
        partial(stage_track.quantise_nm, name="position_mm"),
        {"position_mm": [1.0, 2.0]},
        {"position_mm": vector(2e9, -2e9, size=2, any_shape=True), "name": Kind([])},
    ),
    "stage_track.StageTrack": Call(
        stage_track.StageTrack, {"max_gap_us": 5}, {"max_gap_us": whole(0, optional=True)}
    ),
    "stage_track.StageTrack.append": Call(
        method(stage_track.StageTrack, "append"),
        {"t_us": TIMES, "position_mm": np.zeros(N)},
        {"t_us": integers(2**63, size=N), "position_mm": vector(2e9, size=N)},
    ),
    "stage_track.StageTrack.position_mm": Call(
        method(a_track, "position_mm"),
        {"t_us": [3, 4]},
        {"t_us": integers(2**63, size=2, any_shape=True)},
    ),
    "stage_track.StageTrack.forget_before": Call(
        method(a_track, "forget_before"), {"t_us": 3}, {"t_us": whole()}
    ),
    "sensor_clock.SensorClock": Call(
        sensor_clock.SensorClock,
        {"zero_ns": 5, "window_ns": 10},
        {"zero_ns": whole(optional=True), "window_ns": whole(0)},
    ),
    "sensor_clock.SensorClock.observe": Call(
        method(sensor_clock.SensorClock, "observe"),
        {"t_us": 5, "arrival_ns": 10},
        {"t_us": whole(), "arrival_ns": whole()},
    ),
    "sensor_clock.SensorClock.goes_on": Call(
        method(sensor_clock.SensorClock, "goes_on"),
        {"t_us": 5, "arrival_ns": 10},
        {"t_us": whole(), "arrival_ns": whole()},
    ),
    "sensor_clock.SensorClock.to_ns": Call(
        method(partial(sensor_clock.SensorClock, 7), "to_ns"), {"t_us": 3}, {"t_us": whole()}
    ),
    "sensor_clock.SensorClock.to_us": Call(
        method(partial(sensor_clock.SensorClock, 7), "to_us"), {"t_ns": 3}, {"t_ns": whole()}
    ),
    "sensor_clock.SensorClock.adopt": Call(
        method(sensor_clock.SensorClock, "adopt"), {"line": clock_line.ClockLine(0, 0)}
    ),
    "clock_line.ClockLine": Call(
        clock_line.ClockLine,
        {"origin_us": 5, "origin_ns": 7, "drift_ppb": 9},
        {
            "origin_us": whole(T_MAX),
            "origin_ns": whole(T_MAX + 1, -T_MAX - 1),
            "drift_ppb": whole(200_001, -200_001),
        },
    ),
    "clock_line.ClockLine.to_ns": Call(
        clock_line.ClockLine(5, 7, 9).to_ns, {"t_us": 3}, {"t_us": whole(T_MAX, -T_MAX)}
    ),
    "clock_line.ClockLine.to_us": Call(
        clock_line.ClockLine(5, 7, 9).to_us, {"t_ns": 3}, {"t_ns": whole(T_MAX + 1)}
    ),
    "clock_line.ClockLine.shifted": Call(
        clock_line.ClockLine(5, 7, 9).shifted, {"by_ns": 3}, {"by_ns": whole(2 * T_MAX + 1)}
    ),
    "lower_envelope.LowerEnvelope": Call(
        lower_envelope.LowerEnvelope, {"window_ns": 10}, {"window_ns": whole(0, T_MAX + 1)}
    ),
    "lower_envelope.LowerEnvelope.observe": Call(
        method(partial(lower_envelope.LowerEnvelope, 10), "observe"),
        {"t_us": 5, "arrival_ns": 10},
        {"t_us": whole(T_MAX), "arrival_ns": whole(T_MAX + 1)},
    ),
    "edge_clock.EdgeClock": Call(edge_clock.EdgeClock, {"pulses": None}),
    "edge_clock.EdgeClock.add": Call(
        method(edge_clock.EdgeClock, "add"),
        {"t_us": TIMES, "polarity": SIGNS},
        {"t_us": integers(2**63, size=N), "polarity": POLARITY},
    ),
    "edge_clock.EdgeClock.update": Call(
        method(edge_clock.EdgeClock, "update"),
        {"track": a_track(), "arrivals": clock_line.ClockLine(0, 0), "now": True},
    ),
    "edge_fit.fit_edges": Call(
        edge_fit.fit_edges,
        {
            "t_us": np.arange(8),
            "track": a_track(),
            "pulses": PULSES,
            "arrivals": clock_line.ClockLine(0, 0),
        },
        {"t_us": integers(2**63, size=8)},
    ),
    "pulses.PulseTrain": Call(
        pulses.PulseTrain,
        {"first_mm": 0.0, "interval_mm": 2.0, "count": 3},
        {"first_mm": number(1e7, -1e7), "interval_mm": number(0.0, -1.0), "count": whole(-1)},
    ),
    "pulses.PulseTrain.nearest": Call(
        PULSES.nearest, {"position_mm": np.zeros(2)}, {"position_mm": reals()}
    ),
    "pulses.PulseTrain.offset_mm": Call(
        PULSES.offset_mm, {"position_mm": np.zeros(2)}, {"position_mm": reals()}
    ),
    "pulses.leading_edges": Call(
        pulses.leading_edges,
        {"t_us": TIMES, "polarity": SIGNS},
        {"t_us": integers(2**63, size=N), "polarity": POLARITY},
    ),
    "modulation.Modulation": Call(
        modulation.Modulation,
        {"frequency_hz": 70.0, "duty": 0.5, "waveform": "square", "on_edge_us": 0},
        {
            "frequency_hz": number(15.9, 20_001.0),
            "duty": number(0.0, 1.0),
            "waveform": text(),
            "on_edge_us": whole(T_MAX + 1, -T_MAX - 1, optional=True),
        },
    ),
    "modulation.Modulation.edge_us": Call(LASER.edge_us, {"index": 3}, {"index": whole()}),
    "motion.MotionPlan": Call(
        motion.MotionPlan,
        {
            "start_ns": 0,
            "position_mm": 0.0,
            "velocity_mm_s": 1.0,
            "durations_s": (1.0,),
            "accelerations_mm_s2": (2.0,),
        },
        {
            "start_ns": whole(),
            "position_mm": number(),
            "velocity_mm_s": number(),
            "durations_s": vector(-1.0, size=1),
            "accelerations_mm_s2": vector(size=1),
        },
    ),
    "motion.MotionPlan.state": Call(
        motion.plan_move(0, 0.0, 5.0, 1.0, 1.0).state,
        {"t_ns": [3, 4]},
        {"t_ns": integers(2**63, size=2, any_shape=True)},
    ),
    "motion.MotionPlan.passing_s": Call(
        motion.plan_move(0, 0.0, 5.0, 1.0, 1.0).passing_s,
        {"position_mm": [1.0, 2.0]},
        {"position_mm": vector(size=2)},
    ),
    "motion_fit.MotionFit": Call(
        motion_fit.MotionFit, {"tolerance_mm": 1e-3}, {"tolerance_mm": number(0.0)}
    ),
    "motion_fit.MotionFit.add_reading": Call(
        method(a_fit, "add_reading"),
        {"position_mm": 1.0, "latest_ns": 10**9, "earliest_ns": 10**9 - 5},
        {
            "position_mm": number(2e9, -2e9),
            "latest_ns": whole(),
            "earliest_ns": whole(10**9 + 1, optional=True),
        },
    ),
    "motion_fit.MotionFit.expect_move": Call(
        method(a_fit, "expect_move"), {"plan": motion.plan_move(0, 0.0, 5.0, 1.0, 1.0)}, {}
    ),
    "motion_fit.MotionFit.expect_stop": Call(
        method(a_fit, "expect_stop"),
        {"at_ns": 10**9, "deceleration_mm_s2": 1.0},
        {"at_ns": whole(), "deceleration_mm_s2": number(0.0)},
    ),
    "motion_fit.MotionFit.expect_unknown": Call(
        method(a_fit, "expect_unknown"), {"at_ns": 10**9}, {"at_ns": whole()}
    ),
    "motion_fit.MotionFit.discard_motion": Call(method(a_fit, "discard_motion"), {}, {}),
    "motion_fit.MotionFit.expected_mm": Call(
        method(a_fit, "expected_mm"),
        {"earliest_ns": 10**9, "latest_ns": 2 * 10**9},
        {"earliest_ns": whole(), "latest_ns": whole()},
    ),
    "motion_fit.MotionFit.state": Call(
        method(a_fit, "state"),
        {"t_ns": [3, 4]},
        {"t_ns": integers(2**63, size=2, any_shape=True)},
    ),
    "motion.plan_move": Call(
        motion.plan_move,
        {
            "start_ns": 0,
            "position_mm": 0.0,
            "target_mm": 5.0,
            "speed_mm_s": 1.0,
            "acceleration_mm_s2": 1.0,
        },
        {
            "start_ns": whole(),
            "position_mm": number(),
            "target_mm": number(),
            "speed_mm_s": number(0.0),
            "acceleration_mm_s2": number(0.0),
        },
    ),
    "motion.plan_stop": Call(
        motion.plan_stop,
        {"plan": motion.plan_move(0, 0.0, 5.0, 1.0, 1.0), "at_ns": 10, "deceleration_mm_s2": 1.0},
        {"at_ns": whole(), "deceleration_mm_s2": number(0.0)},
    ),
    "phase_estimate.estimate_phase": Call(
        phase_estimate.estimate_phase,
        {"t_us": TIMES, "polarity": SIGNS, "modulation": LASER},
        {"t_us": integers(2**63, size=N), "polarity": POLARITY},
    ),
    "phase_gate.phase_gate": Call(
        phase_gate.phase_gate,
        {"modulation": LASER, "gate_us": 1000},
        {"gate_us": whole(-1, 100_001)},
    ),
}
