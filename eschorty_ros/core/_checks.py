"""Checks at the boundary: what compiled code would wrap around, numpy would cast silently."""

from __future__ import annotations

import math
import os
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from eschorty_ros.core.errors import ArgumentError

SMALLEST = 2.3e-308
"""Positive numbers below have no reciprocal, or lose their digits."""
TIME_LIMIT = 1 << 62
"""Times, us or ns, stay within this, so that sums and differences of two fit 64 bits."""


def number(name: str, value: Any, low: float = -math.inf, high: float = math.inf) -> float:
    """``value`` as a finite float from ``low`` to ``high``."""
    real = _float(value)
    if not (math.isfinite(real) and low <= real <= high):
        raise ArgumentError(f"{name} is {short(value)}; {_span('a finite number', low, high)}")
    return real


def number_or_nan(name: str, value: Any, low: float = -math.inf) -> float:
    """``value`` as a float from ``low`` on, NaN where it is unknown."""
    if isinstance(value, Real) and value != value:
        return math.nan
    return number(name, value, low)


def positive(name: str, value: Any) -> float:
    """``value`` as a finite float above 0, with a finite reciprocal."""
    real = _float(value)
    if not SMALLEST < real < math.inf:
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
    array = as_array(name, values)
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
    array = as_array(name, values)
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


def exact(name: str, values: Any, dtype: DTypeLike, size: int | None = None) -> NDArray[Any]:
    """``values`` as compiled code takes them: one contiguous axis of just this dtype."""
    if not isinstance(values, np.ndarray) or values.dtype != dtype or values.ndim != 1:
        raise ArgumentError(f"{name} is {_form(values)}; give one axis of {np.dtype(dtype)}")
    if size is not None and values.size != size:
        raise ArgumentError(f"{name} has {values.size} entries; give {size}")
    return np.ascontiguousarray(values)


def times(name: str, values: ArrayLike) -> NDArray[np.int64]:
    """Integer times of any shape as int64; floats are refused, since they lose microseconds."""
    array = as_array(name, values)
    if array.size and array.dtype.kind not in "iu":
        raise ArgumentError(f"{name} has dtype {array.dtype}; give integers")
    if array.dtype == np.uint64 and array.size and int(array.max()) > TIME_LIMIT:
        raise ArgumentError(f"{name} holds {array.max()}; choose {TIME_LIMIT} at most")
    return array.astype(np.int64, copy=False)


def selection(name: str, which: ArrayLike, size: int) -> NDArray[Any]:
    """``which`` as a mask of ``size`` entries or as indices below it."""
    array = as_array(name, which)
    if array.size == 0:
        return np.empty(0, dtype=np.intp)
    if array.dtype == np.bool_ and array.shape == (size,):
        return array
    if array.ndim > 1 or array.dtype.kind not in "iu":
        raise ArgumentError(f"{name} is {_form(array)}; give {size} truth values or indices")
    lowest, highest = int(array.min()), int(array.max())
    if lowest < -size or highest >= size:
        wrong = highest if highest >= size else lowest
        raise ArgumentError(f"{name} holds {wrong}; choose indices below {size}")
    return array


def file_path(name: str, value: Any) -> Path:
    """``value`` as a path that an operating system can be asked for."""
    if not isinstance(value, str | os.PathLike) or "\0" in os.fsdecode(value):
        raise ArgumentError(f"{name} is {short(value)}; give the name of a file")
    return Path(value)


def octets(name: str, data: Any) -> memoryview:
    """``data`` as bytes; arrays of anything wider are refused, not reinterpreted."""
    try:
        view = memoryview(data)
    except TypeError:
        raise ArgumentError(f"{name} is {short(data)}; give bytes") from None
    if view.format not in ("B", "b", "c") or not view.c_contiguous:
        raise ArgumentError(f"{name} is {_form(data)}; give contiguous bytes")
    return view.cast("B")


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


def _form(values: Any) -> str:
    if isinstance(values, np.ndarray):
        return f"{values.dtype} of shape {values.shape}"
    return short(values)


def _float(value: Any) -> float:
    """``value`` as a float; NaN for what is no real number."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, Real):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.inf


def as_array(name: str, values: ArrayLike) -> NDArray[Any]:
    """``values`` as an array of whatever they are; ragged nests are refused."""
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
