"""Settings of the reconstruction; command-line options and ROS parameters are made from them."""

from __future__ import annotations

import os
from collections.abc import Container, Mapping
from dataclasses import dataclass, field, fields, replace
from numbers import Integral, Real
from typing import Any, Self

from eschorty_ros.core.base.errors import ArgumentError, FormatError
from eschorty_ros.core.base.numbers import short
from eschorty_ros.core.clocks import SPEED_LIMIT_MM_S
from eschorty_ros.core.line import CENTROIDS, RETURNS, SIGMA_FLOOR_PX, check_method
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.modulation.phase_gate import GATE_LEARNED, GATE_MAX_US
from eschorty_ros.core.reconstruction.profile_length import periods_max

NOISE_FILTERS = ("none", "activity")
SWITCH = ("off", "on")
KEEP = ("all", "good")
TRIGGER_SOURCES = ("laser", "stage", "none")


def _number(
    default: float, low: float, high: float, unit: str, description: str, **idle: Any
) -> Any:  # a dataclass field stands in for the value it describes
    return field(
        default=default,
        metadata={"description": description, "unit": unit, "range": (low, high), "idle": idle},
    )


def _choice(default: str, choices: tuple[str, ...], description: str, **idle: Any) -> Any:
    return field(
        default=default,
        metadata={"description": description, "unit": "", "choices": choices, "idle": idle},
    )


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of a reconstruction, from events to points.

    Every field carries ``metadata``: ``description``, ``unit`` and ``range`` (both ends included)
    or ``choices``; ``idle`` has another setting's values with which this one has no effect.

    Notes
    -----
    The activity filter is off by default: ``mode_mean`` already ignores background (on a simulated
    plane the median error is the same with and without), and the filter costs more than a third of
    the speed.

    The phase gate, learned by default, is used where it halves the square of the rows' error. At
    edges of a surface any gate makes large errors larger. 1000 us at 70 Hz and 600 us at 300 Hz
    keep the simulated sensor's events. Windows that cover the period, above about 1 kHz, remove
    nothing.

    The compensation of reflectance steps is off by default, since it needs the stage's speed and
    delays profiles by the time that a step takes to cross the line.

    At high frequencies (above about 2 kHz) a column gives too few events for a point per period:
    ``periods_per_profile`` 0 then takes more periods for a profile, as `profile_length` describes.

    Columns and ranges are the region of interest. Events elsewhere are counted and not used.

    Raises
    ------
    ArgumentError
        When a value is outside its range or choices.

    Examples
    --------
    >>> Settings(centroid="median", phase_gate_us=1000).line_width_px
    20.0
    """

    centroid: str = _choice("mode_mean", CENTROIDS, "column estimator")
    returns: str = _choice(
        "strongest", RETURNS, "which of two surfaces in one column to report; first is the nearest"
    )
    keep: str = _choice("all", KEEP, "points to keep; good ones have no flag")
    noise_filter: str = _choice("none", NOISE_FILTERS, "filter before the events are binned")
    phase_gate_us: int = _number(
        GATE_LEARNED, GATE_LEARNED, GATE_MAX_US, "us",
        "keep only events within this time of their laser edge; 0 keeps all, -1 learns the time "
        "and uses it where the mean square error of rows is halved",
    )  # fmt: skip
    trigger_source: str = _choice(
        "laser", TRIGGER_SOURCES,
        "device wired to the camera's trigger input: the laser cuts the periods, the stage's "
        "pulses set the clock (live only), none ignores the edges",
    )  # fmt: skip
    line_width_px: float = _number(
        20.0, 1.0, 200.0, "px", "largest full width at half maximum of the line, in rows"
    )
    events_min: int = _number(
        4, 1, 1000, "events", "fewest events near the line for a column to give a point"
    )
    column_limit: int = _number(4096, 16, 4096, "events", "most events kept per column and profile")
    periods_per_profile: int = _number(
        0, 0, 1000, "periods",
        "modulation periods that make one profile; 0 takes as many as give "
        "a column enough events for a point",
    )  # fmt: skip
    column_first: int = _number(0, 0, 2047, "columns", "first column to reconstruct")
    column_last: int = _number(2047, 0, 2047, "columns", "last column to reconstruct")
    range_min: float = _number(0.0, 0.0, 1000.0, "m", "nearest range to reconstruct; 0 is no limit")
    range_max: float = _number(
        0.0, 0.0, 1000.0, "m", "furthest range to reconstruct; 0 is no limit"
    )
    smoothing_half_width: int = _number(
        8, 0, 20, "columns",
        "most neighbours averaged on either side, fewer where rows show detail; 0 is off",
    )  # fmt: skip
    smoothing_gate_px: float = _number(
        2.0, 0.0, 100.0, "px",
        "neighbours further off in rows are not averaged, unless rows scatter as much",
        smoothing_half_width=(0,),
    )  # fmt: skip
    isolation_gate_px: float = _number(
        12.0, 0.0, 720.0, "px",
        "a point with fewer events than isolation_events needs a neighbouring column this near in "
        "rows",
        isolation_events=(0,),
    )  # fmt: skip
    isolation_events: int = _number(
        10, 0, 1000, "events",
        "points with fewer need a neighbour, see isolation_gate_px; with less than half of the "
        "mean of recent profiles, too, they have the flag few_events",
    )  # fmt: skip
    reflectance: str = _choice(
        "off", SWITCH, "relative reflectance of every point, as two more fields of the cloud"
    )
    footprint_sigma_px: float = _number(
        4.1, 0.3, 60.0, "px",
        "standard deviation of the laser line's intensity over the rows, for reflectance",
        reflectance=("off",),
    )  # fmt: skip
    white_width_px: float = _number(
        0.0, 0.0, 200.0, "px",
        "width (standard deviation of the rows) of a white target, to which reflectance refers; "
        "0 takes the median of each profile",
        reflectance=("off",),
    )  # fmt: skip
    reflectance_compensation: str = _choice(
        "off", SWITCH, "correct the shift of points at reflectance steps"
    )
    stage_speed_mm_s: float = _number(
        0.0, -SPEED_LIMIT_MM_S, SPEED_LIMIT_MM_S, "mm/s",
        "stage speed towards +y, which says how long an edge takes to cross the line; 0 where it "
        "is not known; that of a scan or recording is used instead",
    )  # fmt: skip
    organized: str = _choice(
        "off", SWITCH, "the cloud of a scan as a height map of profiles and columns, NaN where "
        "nothing is",
    )  # fmt: skip
    sigma_factor: float = _number(
        0.0, 0.0, 10.0, "",
        "factor on s/sqrt(N) in a row's standard deviation, 1 for independent events; the scatter "
        "of the stream's rows scales the result",
    )  # fmt: skip
    sigma_floor_px: float = _number(
        SIGMA_FLOOR_PX, 0.01, 10.0, "px",
        "part of a row's standard deviation that more events do not reduce; scaled as with "
        "sigma_factor",
    )  # fmt: skip
    detail: str = _choice(
        "auto", ("auto", "off"),
        "auto: mode_mean learns the line's footprint and takes learned rows, at twice the time, "
        "where these scatter less than means of twice the events would, or, of a line that moves "
        "fast, less than the means",
        centroid=tuple(name for name in CENTROIDS if name != "mode_mean"),
    )  # fmt: skip

    def __post_init__(self) -> None:
        for item in fields(self):
            value = _checked(item.name, getattr(self, item.name), item.default, item.metadata)
            object.__setattr__(self, item.name, value)
        check_method(self.centroid, self.returns)
        if self.column_last < self.column_first:
            raise ArgumentError(
                f"column_last is {self.column_last} and column_first {self.column_first}; choose "
                "a larger column_last"
            )
        if 0.0 < self.range_max <= self.range_min:
            raise ArgumentError(
                f"range_max is {self.range_max:g} m and range_min {self.range_min:g} m; choose a "
                "larger range_max"
            )
        if self.returns == "all" and self.organized == "on":
            raise ArgumentError(
                "returns is 'all' and organized 'on', which has one point per column and profile; "
                "choose strongest, first or last"
            )
        if self.returns == "all" and self.reflectance_compensation == "on":
            raise ArgumentError(
                "returns is 'all' and reflectance_compensation 'on', which follows one surface per "
                "column; choose strongest, first or last"
            )

    @classmethod
    def from_file(cls, values: Mapping[str, Any], file: str | os.PathLike[str]) -> Self:
        """Return the settings that a file names; raises ``FormatError`` when there is no such."""
        unknown = sorted(str(name) for name in values.keys() - {item.name for item in fields(cls)})
        if unknown:
            raise FormatError(f"{file}: {short(unknown[0])} is no setting; remove it")
        try:
            return cls(**values)
        except ArgumentError as error:
            raise FormatError(f"{file}: {error}") from error

    def check_effect(self, names: Container[str]) -> None:
        """Raise ``ArgumentError`` when one of these settings has no effect beside the others."""
        for item in fields(self):
            for other, values in item.metadata["idle"].items():
                if item.name in names and (value := getattr(self, other)) in values:
                    raise ArgumentError(
                        f"{item.name} has no effect while {other} is {value}; leave it out, or "
                        f"choose another {other}"
                    )

    def allowed(self, modulation: Modulation) -> Settings:
        """Return the settings with no more periods in a profile than a modulation allows."""
        most = periods_max(modulation)
        return self if self.periods_per_profile <= most else replace(self, periods_per_profile=most)


def _checked(name: str, value: Any, default: Any, metadata: Any) -> Any:
    """Return the value, numpy's as Python's of the default's type, unless it is out of range."""
    if "choices" in metadata:
        if value not in metadata["choices"]:
            raise ArgumentError(
                f"{name} is {short(value)}; choose one of {', '.join(metadata['choices'])}"
            )
        return value
    low, high = metadata["range"]
    integral = isinstance(default, int)
    kind = "a whole number" if integral else "a number"
    accepted = isinstance(value, Integral if integral else Real) and not isinstance(value, bool)
    if not accepted or not low <= value <= high:
        unit = f" {metadata['unit']}" if metadata["unit"] else ""
        raise ArgumentError(
            f"{name} is {short(value)}; choose {kind} from {low:g} to {high:g}{unit}"
        )
    return type(default)(value)
