"""Checks of single values at the boundary, without numpy, so that small processes start fast."""

from __future__ import annotations

import math
import os
from numbers import Integral, Real
from pathlib import Path
from typing import Any

from eschorty_ros.core.base.errors import ArgumentError

SMALLEST = 2.3e-308
"""Positive numbers below have no reciprocal, or lose their digits."""
TIME_LIMIT = 1 << 62
"""Times, us or ns, stay within this, so that sums and differences of two fit 64 bits."""

SIGMA_PER_MAD = 1.4826
"""Standard deviation of Gaussian errors over their median absolute deviation."""


def number(name: str, value: Any, low: float = -math.inf, high: float = math.inf) -> float:
    """Return ``value`` as a finite float from ``low`` to ``high``."""
    real = _float(value)
    if not (math.isfinite(real) and low <= real <= high):
        raise ArgumentError(f"{name} is {short(value)}; {_span('a finite number', low, high)}")
    return real


def number_or_nan(name: str, value: Any) -> float:
    """Return ``value`` as a finite float, NaN where it is unknown."""
    if isinstance(value, Real) and value != value:
        return math.nan
    return number(name, value)


def positive(name: str, value: Any) -> float:
    """Return ``value`` as a finite float above 0, with a finite reciprocal."""
    real = _float(value)
    if not SMALLEST < real < math.inf:
        raise ArgumentError(f"{name} is {short(value)}; choose a positive number")
    return real


def integer(name: str, value: Any, low: int, high: int) -> int:
    """Return ``value`` as an int from ``low`` to ``high``; floats are refused."""
    wrong = isinstance(value, bool) or not isinstance(value, Integral)
    if wrong or not low <= value <= high:
        raise ArgumentError(f"{name} is {short(value)}; {_span('a whole number', low, high)}")
    return int(value)


def file_path(name: str, value: Any) -> Path:
    """Return ``value`` as a path that the operating system accepts."""
    if not isinstance(value, str | os.PathLike) or "\0" in os.fsdecode(value):
        raise ArgumentError(f"{name} is {short(value)}; give the name of a file")
    return Path(value)


def short(value: Any) -> str:
    """Return the ``repr`` on one line of bounded length."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else text[:57] + "..."


def _float(value: Any) -> float:
    """Return ``value`` as a float; NaN for what is no real number."""
    if isinstance(value, bool) or not isinstance(value, Real):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _span(kind: str, low: float, high: float) -> str:
    if math.isinf(low) and math.isinf(high):
        return f"choose {kind}"
    if math.isinf(high):
        return f"choose {kind}, {low:g} or more"
    return f"choose {kind} from {low} to {high}"
