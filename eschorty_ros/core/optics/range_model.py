"""Scheimpflug ranging: rows to ranges and back, magnification, sampling and lateral scale.

Signs: ``k_mm > 0``, ``k_prime_px < 0``, ``b_prime_px < 0``, so ``K = k k' < 0`` and a row has a
range only where ``row + b' < 0``. The pole ``row = -b'`` is infinitely far away.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from eschorty_ros.core.base.arrays import Array, broadcast, reals
from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.numbers import integer, number, positive

POLE_MARGIN_PX = 1.0
PIXEL_UM = 4.86
COLUMNS = 1280
ROWS = 720
PRINCIPAL_COLUMN = 639.5
PIXELS_MAX = 1 << 16
"""Most pixels along one axis of any sensor."""


def range_of_image_mm(image_px: Array, product_mm_px: float, b_mm: float) -> Array:
    """Return the range, mm, where ``row + b'`` is ``image_px``; kernels compile it for numbers."""
    return product_mm_px / image_px - b_mm


def sigma_of_image_mm(image_px: Array, sigma_row: Array, product_mm_px: float) -> Array:
    """Return the standard deviation of that range, mm; kernels compile it for numbers."""
    return -product_mm_px / (image_px * image_px) * sigma_row


def slope_of_column(column: Array, principal_column: float, slope_per_column: float) -> Array:
    """Return the lateral offset per mm of depth, mm per mm; kernels compile it for numbers."""
    return (column - principal_column) * slope_per_column


def object_scale_mm(focal_mm: float, theta_deg: float) -> float:
    """Return ``k = f / sin(theta)`` in mm, unrounded (Eq. 1).

    Raises ``ArgumentError`` when the focal length is not positive or the tilt not between 0 and 180
    degrees.
    """
    return positive("focal_mm", focal_mm) / _sheet_sine(theta_deg)


def depth_of_field_mm(
    magnification: ArrayLike,
    f_number: float,
    theta_deg: float,
    theta_prime_deg: float,
    pixel_um: float = PIXEL_UM,
) -> Array:
    """Return half the depth of field along the sheet, mm (Eq. 3).

    The object is in focus within plus and minus this length: a tolerance, not a ranging error.

    - ``magnification``: Image size over object size; 0 (the pole) gives infinity.
    - ``theta_deg``, ``theta_prime_deg``: Tilt of the light sheet and of the sensor against the lens
      plane; signs do not matter.
    - ``pixel_um``: Pixel pitch, taken as the circle of confusion.

    Raises ``ArgumentError`` when the magnification is no array of numbers or an optical constant is
    impossible.
    """
    m = reals("magnification", magnification)
    sine = _sheet_sine(abs(number("theta_deg", theta_deg)))
    tilt_deg = abs(number("theta_prime_deg", theta_prime_deg, -90.0, 90.0))
    blur_mm = positive("pixel_um", pixel_um) * 1e-3 * math.cos(math.radians(tilt_deg))
    with np.errstate(divide="ignore", over="ignore", under="ignore"):
        return np.asarray(blur_mm * positive("f_number", f_number) / (m * m * sine))


def _sheet_sine(theta_deg: float) -> float:
    sine = math.sin(math.radians(number("theta_deg", theta_deg, 0.0, 180.0)))
    if not sine > 1e-6:
        raise ArgumentError(f"theta_deg is {theta_deg!r}; choose a sheet tilted by some degrees")
    return sine


@dataclass(frozen=True, slots=True)
class RangeModel:
    """The calibrated range equation of one build (Eq. 2): rows to ranges and back, and scales.

    Raises ``ArgumentError`` when a parameter has the wrong sign or is not finite.

    Examples
    --------
    >>> model = RangeModel(k_mm=24.0, k_prime_px=-37000.0, b_mm=0.0, b_prime_px=-1110.0)
    >>> model.range_mm([0.0, 370.0, 1110.0])
    array([ 800., 1200.,   nan])
    >>> model.row(1200.0)
    array(370.)
    >>> print(f"{model.lateral_mm(column=0, range_mm=1200.0):.1f} mm along the line")
    -155.4 mm along the line
    >>> print(f"{model.range_sigma_mm(row=370.0, sigma_row=0.25):.2f} mm for 0.25 px")
    0.41 mm for 0.25 px
    """

    k_mm: float
    """``f / sin(theta)``, mm, positive."""
    k_prime_px: float
    """``-f / (p sin|theta'|)``, px, negative."""
    b_mm: float
    """Distance from the mechanical datum to the front focal line, mm."""
    b_prime_px: float
    """Row offset, px, at most -1."""
    pixel_um: float = PIXEL_UM
    """Pixel pitch, um."""
    columns: int = COLUMNS
    rows: int = ROWS
    """Sensor size; columns run along the laser line, rows along the range."""
    principal_column: float = PRINCIPAL_COLUMN
    """Column of zero scan angle; pixel centres are integers."""
    theta_deg: float = 90.0
    """Tilt of the light sheet against the lens plane, above 0 up to 90. Ranging needs only ``k``
    and ``k'``; points off the sheet (:meth:`rows_per_mm_off_sheet`) need it too."""
    b_prime_1_px: float = 0.0
    b_prime_2_px: float = 0.0
    """Row offset across the columns, px: ``b'(column) = b' + b'1 u + b'2 u^2`` with ``u`` the
    :meth:`normalised_column`. Roll of the sheet against the sensor, and smile."""

    def __post_init__(self) -> None:
        for name in (
            "k_prime_px", "b_mm", "b_prime_px", "principal_column", "b_prime_1_px", "b_prime_2_px",
        ):  # fmt: skip
            number(name, getattr(self, name))
        for name in ("k_mm", "pixel_um"):
            positive(name, getattr(self, name))
        for name in ("columns", "rows"):
            integer(name, getattr(self, name), 1, PIXELS_MAX)
        if not self.k_prime_px < 0.0:
            raise ArgumentError(f"k_prime_px is {self.k_prime_px!r}; choose a negative value")
        if not self.b_prime_px <= -POLE_MARGIN_PX:
            raise ArgumentError(
                f"b_prime_px is {self.b_prime_px!r}; choose {-POLE_MARGIN_PX:g} or less, "
                "so that row 0 is in front of the pole"
            )
        if not 0.0 < number("theta_deg", self.theta_deg) <= 90.0:
            raise ArgumentError(f"theta_deg is {self.theta_deg!r}; choose above 0 and up to 90")
        edges = self.row_offset_px([0.0, self.columns - 1.0])
        if not edges.max() <= -POLE_MARGIN_PX:
            raise ArgumentError(
                f"b_prime_1_px is {self.b_prime_1_px!r} and b_prime_2_px {self.b_prime_2_px!r}: "
                "the pole comes before row 0 at the edge of the sensor; choose smaller terms"
            )
        if not -math.inf < self.product_mm_px < 0.0:
            raise ArgumentError(
                f"k_mm is {self.k_mm!r} and k_prime_px {self.k_prime_px!r}; their product exceeds "
                "the range of numbers, choose lengths of a real lens"
            )

    @property
    def product_mm_px(self) -> float:
        """``K = k k'``, mm px, negative: the only product ranging depends on."""
        return self.k_mm * self.k_prime_px

    @property
    def focal_mm(self) -> float:
        """Focal length, ``k sin(theta)``, mm."""
        return self.k_mm * math.sin(math.radians(self.theta_deg))

    @property
    def tilt_sine(self) -> float:
        """``sin|theta'|`` that ``k'`` stands for (Eq. 1); 1 or more when no sensor has it."""
        return self.focal_mm / (self.pixel_um * 1e-3 * -self.k_prime_px)

    @property
    def range_limits_mm(self) -> tuple[float, float]:
        """Range at both ends of the principal column, mm; infinite where the pole is on it."""
        near, far = self.range_mm([0.0, self.rows - 1.0])
        return float(near), math.inf if math.isnan(far) else float(far)

    @property
    def pupil_mm(self) -> tuple[float, float]:
        """Range of the lens's foot on the sheet and its distance from the sheet, mm.

        With ``L = f (cot(theta) + cot|theta'|)`` from the lens to the Scheimpflug line these are
        ``L cos(theta) - k - b`` and ``L sin(theta)``; the lens is on the sheet's -y side.

        Raises ``ArgumentError`` when no sensor tilt gives this ``k'`` with this lens.
        """
        if not self.tilt_sine < 1.0:
            raise ArgumentError(
                f"k_prime_px is {self.k_prime_px!r}: no tilt of a {self.pixel_um!r} um sensor "
                f"gives it behind a {self.focal_mm:g} mm lens; check k_mm, k_prime_px and pixel_um"
            )
        theta, tilt = math.radians(self.theta_deg), math.asin(self.tilt_sine)
        baseline_mm = self.focal_mm * (1.0 / math.tan(theta) + 1.0 / math.tan(tilt))
        along_mm = baseline_mm * math.cos(theta) - self.k_mm - self.b_mm
        return along_mm, baseline_mm * math.sin(theta)

    @property
    def slope_per_column(self) -> float:
        """Scan angle of one column, radians: lateral offset per mm of depth, ``p / k``."""
        return self.pixel_um * 1e-3 / self.k_mm

    def normalised_column(self, column: ArrayLike) -> Array:
        """Return ``u``: 0 at the principal column, 1 half a sensor further, any shape."""
        return np.asarray((reals("column", column) - self.principal_column) / (0.5 * self.columns))

    def row_offset_px(self, column: ArrayLike | None = None) -> Array:
        """Return ``b'`` in these columns, px, any shape; in the principal column by default."""
        if column is None:
            return np.asarray(self.b_prime_px)
        u = self.normalised_column(column)
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(self.b_prime_px + u * (self.b_prime_1_px + u * self.b_prime_2_px))

    def range_mm(self, row: ArrayLike, column: ArrayLike | None = None) -> Array:
        """Return the range along the sheet from the mechanical datum, mm (Eq. 2 inverted).

        ``row`` may be off the sensor; ``column`` is the principal one by default. They broadcast.
        NaN within 1 px of the pole and behind it (``row + b' > -1``).
        """
        image_px = self._image_px(row, column)
        return np.asarray(range_of_image_mm(image_px, self.product_mm_px, self.b_mm))

    def row(self, range_mm: ArrayLike, column: ArrayLike | None = None) -> Array:
        """Return the row at which a range appears, px (Eq. 2); ``column`` as in :meth:`range_mm`.

        NaN where ``range + b <= 0``, or so little above that no number holds the row.
        """
        depth, offset = self._depth_mm(range_mm), self.row_offset_px(column)
        broadcast("range_mm and column", depth, offset)
        with np.errstate(over="ignore"):
            row = self.product_mm_px / depth - offset
        return np.where(np.isfinite(row), row, np.nan)

    def magnification(self, row: ArrayLike) -> Array:
        """Return image size over object size at ``row``, principal column: ``(row + b') / k'``.

        A straight line in row that reaches 0 at the pole; NaN behind the pole.
        """
        m = (reals("row", row) + self.b_prime_px) / self.k_prime_px
        return np.where(m >= 0.0, m, np.nan)

    def range_per_row_mm(self, range_mm: ArrayLike) -> Array:
        """Return the range step of one row, mm per px (Eq. 4); NaN where ``range + b <= 0``."""
        depth = self._depth_mm(range_mm)
        with np.errstate(over="ignore"):
            return np.asarray(depth * depth / -self.product_mm_px)

    def range_sigma_mm(
        self, row: ArrayLike, sigma_row: ArrayLike, column: ArrayLike | None = None
    ) -> Array:
        """Return the standard deviation of the range, mm, for ``sigma_row`` px of the row (Eq. 4).

        The arguments broadcast; NaN where :meth:`range_mm` is NaN.
        """
        image, sigma = self._image_px(row, column), reals("sigma_row", sigma_row)
        broadcast("row and sigma_row", image, sigma)
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(sigma_of_image_mm(image, sigma, self.product_mm_px))

    def column_slope(self, column: ArrayLike) -> Array:
        """Return the lateral offset per mm of depth: ``(column - c0) p / k``, mm per mm."""
        columns = reals("column", column)
        return np.asarray(slope_of_column(columns, self.principal_column, self.slope_per_column))

    def lateral_mm(self, column: ArrayLike, range_mm: ArrayLike) -> Array:
        """Return the position along the laser line, mm, of a point at ``range_mm`` in ``column``.

        Image columns meet at the front focal line, so the offset grows with ``range + b``.
        The arguments broadcast; NaN where ``range + b <= 0``.
        """
        slope, depth = self.column_slope(column), self._depth_mm(range_mm)
        broadcast("column and range_mm", slope, depth)
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(slope * depth)

    def rows_per_mm_off_sheet(self, range_mm: ArrayLike) -> Array:
        """Return the rows by which a point 1 mm beside the light sheet appears nearer, px per mm.

        The ray to the lens at :attr:`pupil_mm` crosses the sheet nearer by ``(R - along) / beside``
        mm per mm. Little more than ``k / (p (R + b))``, one over the lateral pitch.

        Positive for a point on the sheet's far side from the lens, +y in ``eschorty_link``: its
        row is *lower* by this number. Across the line's width, rows ``d`` above the centre show
        the surface ``d / rows_per_mm_off_sheet`` behind it (towards -y).

        NaN where ``range + b <= 0``. Raises ``ArgumentError`` when no sensor tilt gives this ``k'``
        with this lens.
        """
        along_mm, beside_mm = self.pupil_mm
        depth = self._depth_mm(range_mm)
        with np.errstate(over="ignore", invalid="ignore"):
            lever = (depth - self.b_mm - along_mm) / beside_mm
            return np.asarray(-self.product_mm_px / (depth * depth) * lever)

    def _image_px(self, row: ArrayLike, column: ArrayLike | None) -> Array:
        """Return ``row + b'``, NaN from one pixel before the pole on."""
        rows, offset = reals("row", row), self.row_offset_px(column)
        broadcast("row and column", rows, offset)
        image = rows + offset
        return np.where(image <= -POLE_MARGIN_PX, image, np.nan)

    def _depth_mm(self, range_mm: ArrayLike) -> Array:
        """Return ``R + b``, NaN where it is not positive."""
        depth = reals("range_mm", range_mm) + self.b_mm
        return np.where(depth > 0.0, depth, np.nan)
