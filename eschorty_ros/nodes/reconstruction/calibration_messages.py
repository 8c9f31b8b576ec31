"""Calibrations and targets as messages."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import yaml

from eschorty_ros.action import Calibrate
from eschorty_ros.core.base.numbers import number, positive
from eschorty_ros.core.calibration import CalibrationReport, KnownTarget
from eschorty_ros.core.optics import PARAMETERS, Calibration
from eschorty_ros.live.calibration_capture import CaptureRequest, Sweep
from eschorty_ros.msg import ActiveCalibration, CalibrationTarget
from eschorty_ros.nodes.ros.conversions import m_from_mm, mm_from_m, stamp_from_ns


def request_from_goal(goal: Any) -> CaptureRequest:
    """Return the request of a ``Calibrate`` goal.

    Raises ``ArgumentError`` for a target whose range or size cannot be.
    """
    sweep = None
    if goal.sweep_speed != 0.0:
        sweep = Sweep(
            mm_from_m(goal.sweep_start),
            mm_from_m(goal.sweep_stop),
            mm_from_m(goal.sweep_speed),
            float(goal.range_per_stage),
        )
    return CaptureRequest(
        targets=tuple(_known_target(target) for target in goal.targets),
        method=goal.method or "joint",
        capture_s=float(goal.capture_time),
        frequency_hz=float(goal.frequency),
        duty=float(goal.duty),
        sweep=sweep,
    )


def _known_target(target: Any) -> KnownTarget:
    name = f"target {target.label}: " if target.label else ""
    positive(f"{name}range", target.range)
    number(f"{name}range_sigma", target.range_sigma, 0.0)
    number(f"{name}size", target.size, 0.0)
    return KnownTarget(
        mm_from_m(target.range),
        mm_from_m(target.range_sigma),
        mm_from_m(target.size) if target.size != 0.0 else math.nan,
        target.column if target.column >= 0.0 else math.nan,
        target.row if target.row >= 0.0 else math.nan,
        target.label,
    )


def target_message(target: KnownTarget) -> CalibrationTarget:
    """Return the message of a known target."""
    return CalibrationTarget(
        range=m_from_mm(target.range_mm),
        range_sigma=m_from_mm(target.sigma_range_mm),
        size=m_from_mm(target.size_mm) if math.isfinite(target.size_mm) else 0.0,
        column=target.column if math.isfinite(target.column) else -1.0,
        row=target.row if math.isfinite(target.row) else -1.0,
        label=target.label,
    )


def active_message(calibration: Calibration, file: str, stamp_ns: int) -> ActiveCalibration:
    """Return the message of the calibration in use since ``stamp_ns``."""
    message = ActiveCalibration(
        name=calibration.name,
        id=calibration.id or "",
        date=calibration.date or "",
        file=file,
        columns=calibration.columns,
        rows=calibration.rows,
        parameters=list(PARAMETERS),
        values=[_value(calibration, name) for name in PARAMETERS],
        residual_rms=_or_nan(calibration.residual_rms_px),
        range_min=math.nan,
        range_max=math.nan,
        yaml=yaml.safe_dump(calibration.as_dict(), sort_keys=False),
    )
    if calibration.range_mm is not None:
        message.range_min, message.range_max = (m_from_mm(mm) for mm in calibration.range_mm)
    message.header.stamp = stamp_from_ns(stamp_ns)
    return message


def fill_result(result: Calibrate.Result, report: CalibrationReport, file: str) -> None:
    """Fill the action's result from a fit."""
    calibration, targets = report.calibration, report.targets.select(report.used)
    names = calibration.parameters_fitted or ()
    result.calibration_id = calibration.id or ""
    result.file = file
    result.parameters = list(names)
    result.values = [_value(calibration, name) for name in names]
    result.covariance = np.array(calibration.covariance or ()).ravel().tolist()
    result.residual_rms = _or_nan(calibration.residual_rms_px)
    result.verdicts = list(report.verdicts)
    result.rejected = [
        *result.rejected, *(f"target {entry.label}: {entry.reason}" for entry in report.rejected)
    ]  # fmt: skip
    result.ranges = (targets.range_mm * 1e-3).tolist()
    result.rows = targets.row.tolist()
    result.residuals = report.residual_px[report.used].tolist()


def _value(calibration: Calibration, name: str) -> float:
    if name == "principal_column":
        return calibration.model().principal_column
    return calibration.object_scale_mm if name == "k_mm" else float(getattr(calibration, name))


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value
