"""The calibration file of one optical build."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import yaml

from eschorty_ros.core.base.errors import ArgumentError, CalibrationError
from eschorty_ros.core.base.files import (
    BARE_NAME,
    atomic_write,
    bare_name_fault,
    config_path,
    is_bare_name,
)
from eschorty_ros.core.base.numbers import file_path, short
from eschorty_ros.core.base.schema import Schema, Within, validate
from eschorty_ros.core.base.yaml_file import parse_yaml, read_yaml
from eschorty_ros.core.optics.range_model import (
    COLUMNS,
    PIXEL_UM,
    POLE_MARGIN_PX,
    ROWS,
    RangeModel,
    object_scale_mm,
)

BUILDS = ("nominal", "config_1", "config_2", "config_3")
SHIPPED = (*BUILDS, "config_3_as_built")
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

Positive = Annotated[float, Within(above=0.0)]
Pixels = Annotated[int, Within(1, 2048)]


@dataclass(frozen=True, kw_only=True)
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

    KIND = "calibration"

    name: str
    focal_length_mm: Positive
    f_number: Positive
    pixel_um: Positive = PIXEL_UM
    theta_deg: Annotated[float, Within(above=0.0, high=90.0)]
    theta_prime_deg: Annotated[float, Within(above=-90.0, below=90.0)]
    k_mm: Positive | None = None
    k_prime_px: Annotated[float, Within(below=0.0)]
    b_mm: float = 0.0
    b_prime_px: Annotated[float, Within(high=-POLE_MARGIN_PX)]
    b_prime_1_px: float = 0.0
    b_prime_2_px: float = 0.0
    columns: Pixels = COLUMNS
    rows: Pixels = ROWS
    roi_px: tuple[int, int, int, int] | None = None
    principal_column: float | None = None
    stage_direction: tuple[float, float, float] = (0.0, 1.0, 0.0)
    id: str | None = None
    date: str | None = None
    parameters_fitted: tuple[str, ...] | None = None
    covariance: tuple[tuple[float, ...], ...] | None = None
    residual_rms_px: Annotated[float, Within(low=0.0)] | None = None
    condition_number: Annotated[float, Within(low=1.0)] | None = None
    range_mm: tuple[float, float] | None = None

    @property
    def label(self) -> str:
        """Return the id of a fit, the name of a design."""
        return self.id or self.name

    def _conflicts(self) -> Iterator[tuple[str, str]]:
        for key, name in (("name", self.name), ("id", self.id)):
            if name is not None and not is_bare_name(name):
                yield key, f"give {BARE_NAME}"
        if self.theta_prime_deg == 0.0:
            yield "theta_prime_deg", "choose a tilted sensor, such as -7.62"
        if self.roi_px is not None:
            column, row, columns, rows = self.roi_px
            fits = 0 <= column < column + columns <= self.columns
            if not (fits and 0 <= row < row + rows <= self.rows):
                remedy = "write first column, first row, columns, rows within the sensor of"
                yield "roi_px", f"{remedy} {self.columns} x {self.rows}"
        model = self.model()
        near_mm, far_mm = model.range_limits_mm
        if not model.tilt_sine < 1.0:
            yield (
                "k_prime_px",
                f"no tilt of the sensor gives it; a {model.focal_mm:g} mm lens needs less than "
                f"{model.k_prime_px * model.tilt_sine:.0f}",
            )
        elif not near_mm > 0.0:
            seen = f"the sensor would see {near_mm:.0f} to {far_mm:.0f} mm"
            yield "b_prime_px", f"{seen}; choose a value at which row 0 has a positive range"
        length = float(np.linalg.norm(self.stage_direction))
        if not abs(length - 1.0) <= 1e-6:
            yield "stage_direction", f"its length is {length:g}; divide it by its length"
        if self.range_mm is not None and not 0.0 < self.range_mm[0] < self.range_mm[1]:
            yield "range_mm", "write the nearest range first, both positive"
        fitted = self.parameters_fitted
        if fitted is not None and not (len(set(fitted)) == len(fitted) and fitted):
            yield "parameters_fitted", "name each fitted parameter once"
        elif not set(fitted or ()) <= set(PARAMETERS):
            yield "parameters_fitted", f"choose of {', '.join(PARAMETERS)}"
        elif self.covariance is not None and (words := self._misfit(self.covariance)):
            yield "covariance", words

    def _misfit(self, covariance: tuple[tuple[float, ...], ...]) -> str:
        size = len(self.parameters_fitted or ())
        if not size or {len(row) for row in (*covariance, covariance)} != {size}:
            return f"write one row and one column for each of the {size} parameters_fitted"
        matrix = np.array(covariance)
        variance = np.diag(matrix)
        scale = np.sqrt(np.abs(variance[:, None])) * np.sqrt(np.abs(variance))
        if np.any(variance < 0.0) or np.any(np.abs(matrix - matrix.T) > 1e-9 * scale):
            return "it is not symmetric with a positive diagonal; fit again"
        return ""

    @property
    def object_scale_mm(self) -> float:
        """``k``: as given, or derived from focal length and sheet tilt without rounding, mm."""
        if self.k_mm is not None:
            return self.k_mm
        return object_scale_mm(self.focal_length_mm, self.theta_deg)

    def model(self) -> RangeModel:
        """Return the range equation of this calibration."""
        middle = (self.columns - 1) / 2
        return RangeModel(
            k_mm=self.object_scale_mm,
            k_prime_px=self.k_prime_px,
            b_mm=self.b_mm,
            b_prime_px=self.b_prime_px,
            pixel_um=self.pixel_um,
            columns=self.columns,
            rows=self.rows,
            principal_column=middle if self.principal_column is None else self.principal_column,
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
    return _read(_find(name_or_path))


def load_named_calibration(folder: str | os.PathLike[str], name: str) -> Calibration:
    """Read a calibration of ``folder`` by its bare name, else the one of that name in ``config/``.

    Bounded in size and time whatever lies in the folder: links, pipes and devices are refused.

    - ``name``: As `save_named_calibration` takes it; with or without ``.yaml``.

    Raises ``CalibrationError`` in one line with file, key, value and remedy.
    """
    path = _named_path(folder, name)
    if os.path.lexists(path):
        return _read(path, follow_links=False)
    if shipped := _shipped(path.stem):
        return _read(shipped)
    raise CalibrationError(
        f"there is no calibration named {short(name)} in {folder}; save it there first, or "
        f"choose one of {', '.join(SHIPPED)}"
    )


def save_named_calibration(
    folder: str | os.PathLike[str], calibration: Calibration, name: str = ""
) -> Path:
    """Write a calibration into ``folder``, made when missing, and return the file's path.

    - ``name``: Without path separators, not beginning with a dot; ``""``: the calibration's id, or
      its name when it has none.

    Raises ``CalibrationError`` when the name is no bare name, or stands for something other than a
    regular file. Raises ``ArgumentError`` when the file cannot be written.
    """
    path = _named_path(folder, calibration.label if name == "" else name)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if os.path.lexists(path) and not stat.S_ISREG(path.lstat().st_mode):
            raise CalibrationError(f"cannot write {path}: it is no regular file; choose a name")
    except OSError as error:
        raise ArgumentError(
            f"cannot write {path}: {error.strerror or error}; choose a folder that is writable"
        ) from error
    save_calibration(calibration, path)
    return path


def _named_path(folder: str | os.PathLike[str], name: str) -> Path:
    if fault := bare_name_fault("name of the calibration", name):
        raise CalibrationError(fault)
    return file_path("folder", folder) / f"{name.removesuffix('.yaml')}.yaml"


def _read(path: Path, follow_links: bool = True) -> Calibration:
    document = read_yaml(path, CalibrationError, follow_links)
    if isinstance(document.data, str) and _may_be_shipped(document.data):
        document = read_yaml(_find(document.data), CalibrationError)
    try:
        return validate(Calibration, document, CalibrationError)
    except ArgumentError as error:
        raise CalibrationError(f"{path}: {error}") from error


def save_calibration(calibration: Calibration, path: str | os.PathLike[str]) -> None:
    """Write a calibration atomically.

    Keys that were never given are left out, so a derived ``k_mm`` stays derived.

    Raises
    ------
    CalibrationError
        When the file would not read back as the same calibration.
    ArgumentError
        For what is no `Calibration`, or when the path cannot be written.
    """
    if not isinstance(calibration, Calibration):
        raise ArgumentError(f"calibration is {short(calibration)}; give a Calibration")
    file = file_path("path", path)
    data = calibration.as_dict()
    text = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, allow_unicode=True)
    written = text.encode()
    again = validate(Calibration, parse_yaml(written, file, CalibrationError), CalibrationError)
    if again != calibration:
        raise CalibrationError(f"{file}: the calibration does not survive YAML; check its texts")
    with atomic_write(file) as stream:
        stream.write(written)


def refuse_other_instrument(candidate: Calibration, active: Calibration) -> None:
    """Refuse a calibration that was made with another sensor, window or build.

    - ``candidate``, ``active``: The one that is to replace, and the one that is in use.

    Raises ``CalibrationError``, which names the first key that differs and both values.
    """
    for key, meaning in _OF_THE_INSTRUMENT.items():
        theirs, ours = getattr(candidate, key), getattr(active, key)
        if theirs != ours:
            raise CalibrationError(
                f"the calibration's {key} ({meaning}) is {theirs!r} and the instrument's "
                f"{ours!r}; load one made with this instrument, or start it with the other one"
            )


def refuse_other_sensor(
    events: str, width: int, height: int, calibration: Calibration, *, larger: bool = False
) -> None:
    """Refuse events of a sensor of another size than the calibration's; 0 x 0 is unknown.

    A ``larger`` one may be taken: its other events are counted as outside the sensor, and an
    emulated EVK4 may serve a build of fewer pixels.

    Raises ``CalibrationError``, which names the ``events`` and both sizes.
    """
    columns, rows = calibration.columns, calibration.rows
    holds = larger and width >= columns and height >= rows
    if not holds and (width, height) not in ((0, 0), (columns, rows)):
        raise CalibrationError(
            f"{events} is of a sensor of {width} x {height} and {calibration.name} of one of "
            f"{columns} x {rows}; give the calibration of this camera"
        )


def _may_be_shipped(text: str) -> bool:
    return re.fullmatch(r"[A-Za-z0-9_-]{0,100}", text) is not None


def _shipped(name: str) -> Path | None:
    """Return the file of a calibration in ``config/``, ``None`` when there is none."""
    if not _may_be_shipped(name):
        return None
    return config_path(f"{name}.yaml")


def _find(name_or_path: str | os.PathLike[str]) -> Path:
    file_path("name_or_path", name_or_path)
    text = os.fsdecode(name_or_path)
    if not _may_be_shipped(text):
        return Path(text)
    if shipped := _shipped(text):
        return shipped
    raise CalibrationError(
        f"there is no calibration named {text!r}; choose one of {', '.join(SHIPPED)} "
        "or give a path ending in .yaml"
    )


def config_file(name: str) -> Path:
    """Return the path of a file in ``config/``.

    Raises ``CalibrationError`` when there is none of that name.
    """
    found = config_path(os.fspath(file_path("name", name)))
    if found is None:
        raise CalibrationError(
            f"name is {name!r}, and config/ has no such file; give its path instead"
        )
    return found
