"""Checks at the boundary: what compiled code would wrap around, numpy would cast silently."""

from __future__ import annotations

import math
from numbers import Integral, Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from eschorty_ros.core.errors import ArgumentError


def number(name: str, value: Any, low: float = -math.inf, high: float = math.inf) -> float:
    """``value`` as a finite float from ``low`` to ``high``."""
    real = _float(value)
    if not (math.isfinite(real) and low <= real <= high):
        raise ArgumentError(f"{name} is {short(value)}; {_span('a finite number', low, high)}")
    return real


def positive(name: str, value: Any) -> float:
    """``value`` as a finite float above 0."""
    real = _float(value)
    if not 0.0 < real < math.inf:
        raise ArgumentError(f"{name} is {short(value)}; choose a positive number")
    return real


def whole(name: str, value: Any, low: int, high: int) -> int:
    """``value`` as an int from ``low`` to ``high``; no floats, not even whole ones."""
    wrong = isinstance(value, (bool, np.bool_)) or not isinstance(value, Integral)
    if wrong or not low <= value <= high:
        raise ArgumentError(f"{name} is {short(value)}; {_span('a whole number', low, high)}")
    return int(value)


def reals(name: str, values: ArrayLike) -> NDArray[np.float64]:
    """``values`` of any shape as float64; NaN and infinity pass, texts and objects do not."""
    array = _array(name, values)
    if array.dtype.kind not in "iuf":
        raise ArgumentError(f"{name} has dtype {array.dtype}; give real numbers")
    return array.astype(np.float64, copy=False)


def vector(name: str, values: ArrayLike) -> NDArray[np.float64]:
    """``values`` as one axis of finite float64."""
    array = reals(name, values)
    if array.ndim != 1:
        raise ArgumentError(f"{name} has shape {array.shape}; give one axis")
    wrong = ~np.isfinite(array)
    if wrong.any():
        raise ArgumentError(f"{name} is {array[wrong][0]}; give finite numbers")
    return array


def whole_vector(
    name: str, values: ArrayLike, dtype: DTypeLike, low: int, high: int
) -> NDArray[Any]:
    """``values`` as a contiguous vector of ``dtype``, each from ``low`` to ``high``."""
    array = _array(name, values)
    if array.ndim != 1 or (array.size and array.dtype.kind not in "iu"):
        raise ArgumentError(
            f"{name} is {array.dtype} of shape {array.shape}; give one axis of integers"
        )
    if array.size:
        lowest, highest = int(array.min()), int(array.max())
        if lowest < low or highest > high:
            wrong = lowest if lowest < low else highest
            raise ArgumentError(f"{name} holds {wrong}; choose {low} to {high}")
    return np.ascontiguousarray(array, dtype=dtype)


def broadcast(names: str, *arrays: NDArray[Any]) -> tuple[int, ...]:
    """Common shape of ``arrays``."""
    try:
        return np.broadcast_shapes(*(array.shape for array in arrays))
    except ValueError:
        shapes = " and ".join(str(array.shape) for array in arrays)
        raise ArgumentError(f"{names} have shapes {shapes}; give shapes that fit") from None


def short(value: Any) -> str:
    """``repr`` on one line of bounded length."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else text[:57] + "..."


def _float(value: Any) -> float:
    """``value`` as a float; NaN for what is no real number."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, Real):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _array(name: str, values: ArrayLike) -> NDArray[Any]:
    try:
        return np.asarray(values)
    except (ValueError, TypeError, OverflowError) as error:
        raise ArgumentError(f"{name} is {short(values)}; give numbers") from error


def _span(kind: str, low: float, high: float) -> str:
    if math.isinf(low) and math.isinf(high):
        return f"choose {kind}"
    if math.isinf(high):
        return f"choose {kind}, {low:g} or more"
    return f"choose {kind} from {low} to {high}"
