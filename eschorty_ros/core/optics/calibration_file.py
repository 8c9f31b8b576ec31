"""The calibration file of one optical build."""

from __future__ import annotations

import datetime
import os
import re
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import yaml
from pydantic import Field, field_validator, model_validator

from eschorty_ros.core.base.arrays import file_path
from eschorty_ros.core.base.errors import CalibrationError
from eschorty_ros.core.base.files import atomic_write, config_folders
from eschorty_ros.core.base.yaml_file import Schema, read_yaml, validate
from eschorty_ros.core.optics.range_model import (
    COLUMNS,
    PIXEL_UM,
    POLE_MARGIN_PX,
    PRINCIPAL_COLUMN,
    ROWS,
    RangeModel,
    object_scale_mm,
)

BUILDS = ("nominal", "config_1", "config_2", "config_3")
PARAMETERS = (
    "k_mm",
    "k_prime_px",
    "b_mm",
    "b_prime_px",
    "b_prime_1_px",
    "b_prime_2_px",
    "principal_column",
)
_OF_THE_INSTRUMENT = {
    "name": "build",
    "columns": "sensor columns",
    "rows": "sensor rows",
    "pixel_um": "pixel pitch in um",
    "roi_px": "window that the camera reads out",
}

Positive = Annotated[float, Field(gt=0.0)]
# A strict tuple refuses a YAML list; its items stay strict.
Vector = Annotated[tuple[float, float, float], Field(strict=False)]
Window = Annotated[tuple[int, int, int, int], Field(strict=False)]


class Calibration(Schema):
    """The optical build that turns rows and columns into millimetres.

    The keys are those of ``calibration.yaml``, with the unit in the name. Signs as in
    `RangeModel`; the sign of ``theta_prime_deg`` is the side to which the sensor is tilted.
    ``k_mm`` left out means ``focal_length_mm / sin(theta_deg)``, unrounded. ``roi_px`` is the
    window that the camera reads out, ``[first column, first row, columns, rows]``; left out it is
    the whole sensor. ``b_prime_1_px`` and ``b_prime_2_px`` are roll and smile of the laser line,
    0 unless fitted. ``stage_direction`` is the unit vector of stage travel in ``eschorty_link``.
    The keys from ``id`` on describe a fit: ``covariance`` belongs to ``parameters_fitted`` in
    that order and in their units, ``range_mm`` is the span of the targets.
    """

    name: Annotated[str, Field(min_length=1)]
    focal_length_mm: Positive
    f_number: Positive
    pixel_um: Positive = PIXEL_UM
    theta_deg: Annotated[float, Field(gt=0.0, le=90.0)]
    theta_prime_deg: Annotated[float, Field(gt=-90.0, lt=90.0)]
    k_mm: Positive | None = None
    k_prime_px: Annotated[float, Field(lt=0.0)]
    b_mm: float = 0.0
    b_prime_px: Annotated[float, Field(le=-POLE_MARGIN_PX)]
    b_prime_1_px: float = 0.0
    b_prime_2_px: float = 0.0
    columns: Annotated[int, Field(gt=0, le=2048)] = COLUMNS
    rows: Annotated[int, Field(gt=0, le=2048)] = ROWS
    roi_px: Window | None = None
    principal_column: float = PRINCIPAL_COLUMN
    stage_direction: Vector = (0.0, 1.0, 0.0)
    id: str | None = None
    date: str | None = None
    parameters_fitted: Annotated[tuple[str, ...], Field(strict=False)] | None = None
    covariance: (
        Annotated[
            tuple[Annotated[tuple[float, ...], Field(strict=False)], ...], Field(strict=False)
        ]
        | None
    ) = None
    residual_rms_px: Annotated[float, Field(ge=0.0)] | None = None
    condition_number: Annotated[float, Field(ge=1.0)] | None = None
    range_mm: Annotated[tuple[float, float], Field(strict=False)] | None = None

    @field_validator("date", mode="before")
    @classmethod
    def _date_as_text(cls, value: Any) -> Any:
        # YAML turns an unquoted date into a date object.
        return value.isoformat() if isinstance(value, datetime.date) else value

    @field_validator("theta_prime_deg")
    @classmethod
    def _tilted(cls, value: float) -> float:
        if value == 0.0:
            raise ValueError("choose a tilted sensor, such as -7.62")
        return value

    @model_validator(mode="after")
    def _window_on_the_sensor(self) -> Calibration:
        if self.roi_px is None:
            return self
        column, row, columns, rows = self.roi_px
        fits = 0 <= column < column + columns <= self.columns
        if not (fits and 0 <= row < row + rows <= self.rows):
            raise ValueError(
                f"roi_px {list(self.roi_px)} leaves the sensor of {self.columns} x {self.rows}; "
                "write first column, first row, columns, rows"
            )
        return self

    @field_validator("stage_direction")
    @classmethod
    def _unit_vector(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        length = float(np.linalg.norm(value))
        if abs(length - 1.0) > 1e-6:
            raise ValueError(f"its length is {length:g}; divide it by its length")
        return value

    @field_validator("range_mm")
    @classmethod
    def _ordered(cls, value: tuple[float, float] | None) -> tuple[float, float] | None:
        if value is not None and not 0.0 < value[0] < value[1]:
            raise ValueError("write the nearest range first, both positive")
        return value

    @field_validator("parameters_fitted")
    @classmethod
    def _known_parameters(cls, value: tuple[str, ...] | None) -> tuple[str, ...] | None:
        known = value is None or (value and set(value) <= set(PARAMETERS))
        if not known or (value and len(set(value)) != len(value)):
            raise ValueError(f"name each fitted parameter once, of {', '.join(PARAMETERS)}")
        return value

    @model_validator(mode="after")
    def _covariance_fits(self) -> Calibration:
        if self.covariance is None:
            return self
        size = len(self.parameters_fitted or ())
        if not size or len(self.covariance) != size or {len(r) for r in self.covariance} != {size}:
            raise ValueError(
                f"covariance does not belong to the {size} parameters_fitted; write one row and "
                "one column for each"
            )
        matrix = np.array(self.covariance)
        scale = np.sqrt(np.abs(np.outer(np.diag(matrix), np.diag(matrix))))
        if np.any(np.diag(matrix) < 0.0) or np.any(np.abs(matrix - matrix.T) > 1e-9 * scale):
            raise ValueError("covariance is not symmetric with a positive diagonal; fit again")
        return self

    @property
    def object_scale_mm(self) -> float:
        """``k``: as given, or derived from focal length and sheet tilt without rounding, mm."""
        if self.k_mm is not None:
            return self.k_mm
        return object_scale_mm(self.focal_length_mm, self.theta_deg)

    def model(self) -> RangeModel:
        """Return the range equation of this calibration."""
        return RangeModel(
            k_mm=self.object_scale_mm,
            k_prime_px=self.k_prime_px,
            b_mm=self.b_mm,
            b_prime_px=self.b_prime_px,
            pixel_um=self.pixel_um,
            columns=self.columns,
            rows=self.rows,
            principal_column=self.principal_column,
            theta_deg=self.theta_deg,
            b_prime_1_px=self.b_prime_1_px,
            b_prime_2_px=self.b_prime_2_px,
        )


def load_calibration(name_or_path: str | os.PathLike[str]) -> Calibration:
    """Read a calibration.

    Parameters
    ----------
    name_or_path : str or path
        A path, or a bare name such as ``config_3`` that is looked up in ``config/`` of the
        source tree or of the installed package. A file may itself hold nothing but such a name.

    Raises
    ------
    CalibrationError
        One line naming file, key, value and remedy.

    Examples
    --------
    >>> from eschorty_ros.core.optics import load_calibration
    >>> build = load_calibration("config_3")
    >>> build.k_prime_px, build.b_prime_px
    (-37261.86, -1142.74)
    >>> print(build.model().range_mm([0, 719]).round(1))
    [ 784.6 2116. ]
    """
    path = _find(name_or_path)
    data = read_yaml(path, CalibrationError)
    if isinstance(data, str) and _is_bare_name(data):
        path = _find(data)
        data = read_yaml(path, CalibrationError)
    return validate(Calibration, data, path, CalibrationError)


def save_calibration(calibration: Calibration, path: str | os.PathLike[str]) -> None:
    """Write a calibration atomically.

    Keys that were never given are left out, so a derived ``k_mm`` stays derived.

    Raises
    ------
    CalibrationError
        When the file would not read back as the same calibration.
    ArgumentError
        When the path cannot be written.
    """
    data = calibration.model_dump(mode="json", exclude_none=True)
    text = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, allow_unicode=True)
    if validate(Calibration, yaml.safe_load(text), path, CalibrationError) != calibration:
        raise CalibrationError(f"{path}: the calibration does not survive YAML; check its texts")
    with atomic_write(path) as stream:
        stream.write(text.encode())


def refuse_other_instrument(candidate: Calibration, active: Calibration) -> None:
    """Refuse a calibration that was made with another sensor, window or build.

    Parameters
    ----------
    candidate, active : Calibration
        The one that is to replace, and the one that is in use.

    Raises
    ------
    CalibrationError
        Names the first key that differs and both values.
    """
    for key, meaning in _OF_THE_INSTRUMENT.items():
        theirs, ours = getattr(candidate, key), getattr(active, key)
        if theirs != ours:
            raise CalibrationError(
                f"the calibration's {key} ({meaning}) is {theirs!r} and the instrument's "
                f"{ours!r}; load one made with this instrument, or start it with the other one"
            )


def _is_bare_name(text: str) -> bool:
    return re.fullmatch(r"[A-Za-z0-9_-]+", text) is not None


def _find(name_or_path: str | os.PathLike[str]) -> Path:
    text = os.fspath(file_path("name_or_path", name_or_path))
    if not _is_bare_name(text):
        return Path(text)
    for folder in config_folders():
        candidate = folder / f"{text}.yaml"
        if candidate.is_file():
            return candidate
    raise CalibrationError(
        f"there is no calibration named {text!r}; choose one of {', '.join(BUILDS)} "
        "or give a path ending in .yaml"
    )


def config_file(name: str) -> Path:
    """Return the path of a file in ``config/``.

    Raises
    ------
    CalibrationError
        When there is none of that name.
    """
    wanted = file_path("name", name)
    for folder in config_folders():
        if (folder / wanted).is_file():
            return folder / wanted
    raise CalibrationError(f"name is {name!r}, and config/ has no such file; give its path instead")
