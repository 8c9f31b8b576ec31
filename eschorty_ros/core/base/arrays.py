"""Checks of arrays at the boundary: compiled code would wrap bad values, numpy cast them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.numbers import TIME_LIMIT, short

Array = NDArray[np.float64]
"""float64 values of any shape."""


def reals(name: str, values: ArrayLike) -> NDArray[np.float64]:
    """Return ``values`` of any shape as float64; NaN and infinity pass, text and objects do not."""
    array = as_array(name, values)
    if array.dtype.kind not in "iuf":
        raise ArgumentError(f"{name} has dtype {array.dtype}; give real numbers")
    return array.astype(np.float64, copy=False)


def vector(name: str, values: ArrayLike) -> NDArray[np.float64]:
    """Return ``values`` as one axis of finite float64."""
    array = reals(name, values)
    if array.ndim != 1:
        raise ArgumentError(f"{name} has shape {array.shape}; give one axis")
    wrong = ~np.isfinite(array)
    if wrong.any():
        raise ArgumentError(f"{name} is {array[wrong][0]}; give finite numbers")
    return array


def integer_vector(
    name: str, values: ArrayLike, dtype: DTypeLike, low: int, high: int
) -> NDArray[Any]:
    """Return ``values`` as a contiguous vector of ``dtype``, each from ``low`` to ``high``."""
    array = as_array(name, values)
    if array.ndim != 1 or (array.size and array.dtype.kind not in "iub"):
        raise ArgumentError(
            f"{name} is {array.dtype} of shape {array.shape}; give one axis of integers"
        )
    if array.size:
        lowest, highest = int(array.min()), int(array.max())
        if lowest < low or highest > high:
            wrong = lowest if lowest < low else highest
            raise ArgumentError(f"{name} holds {wrong}; choose {low} to {high}")
    return np.ascontiguousarray(array, dtype=dtype)


def ordered_times(name: str, values: ArrayLike) -> NDArray[np.int64]:
    """Return ``values`` as a vector of times, us, that never fall."""
    t_us = integer_vector(name, values, np.int64, -TIME_LIMIT, TIME_LIMIT)
    fall = np.flatnonzero(np.diff(t_us) < 0)
    if fall.size:
        before, after = t_us[fall[0]], t_us[fall[0] + 1]
        raise ArgumentError(f"{name} goes from {before} to {after}; sort the events by time")
    return t_us


def exact(name: str, values: Any, dtype: DTypeLike, size: int | None = None) -> NDArray[Any]:
    """Return ``values`` for compiled code: one contiguous axis of exactly this dtype."""
    if not isinstance(values, np.ndarray) or values.dtype != dtype or values.ndim != 1:
        raise ArgumentError(f"{name} is {_form(values)}; give one axis of {np.dtype(dtype)}")
    if size is not None and values.size != size:
        raise ArgumentError(f"{name} has {values.size} entries; give {size}")
    return np.ascontiguousarray(values)


def times(name: str, values: ArrayLike) -> NDArray[np.int64]:
    """Return integer times of any shape as int64; floats, which lose digits, are refused."""
    array = as_array(name, values)
    if array.size and array.dtype.kind not in "iu":
        raise ArgumentError(f"{name} has dtype {array.dtype}; give integers")
    if array.dtype == np.uint64 and array.size and int(array.max()) > TIME_LIMIT:
        raise ArgumentError(f"{name} holds {array.max()}; choose {TIME_LIMIT} at most")
    return array.astype(np.int64, copy=False)


def selection(name: str, which: ArrayLike, size: int) -> NDArray[Any]:
    """Return ``which`` as a mask of ``size`` entries or as indices below it."""
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


def byte_view(name: str, data: Any) -> memoryview:
    """Return ``data`` as bytes; arrays of anything wider are refused, not reinterpreted."""
    try:
        view = memoryview(data)
    except TypeError:
        raise ArgumentError(f"{name} is {short(data)}; give bytes") from None
    if view.format not in ("B", "b", "c") or not view.c_contiguous:
        raise ArgumentError(f"{name} is {_form(data)}; give contiguous bytes")
    return view.cast("B")


def broadcast(names: str, *arrays: NDArray[Any]) -> None:
    """Refuse ``arrays`` without a common shape."""
    try:
        np.broadcast_shapes(*(array.shape for array in arrays))
    except ValueError:
        shapes = " and ".join(str(array.shape) for array in arrays)
        raise ArgumentError(f"{names} have shapes {shapes}; give shapes that fit") from None


def _form(values: Any) -> str:
    if isinstance(values, np.ndarray):
        return f"{values.dtype} of shape {values.shape}"
    return short(values)


def as_array(name: str, values: ArrayLike) -> NDArray[Any]:
    """Return ``values`` as an array of their own dtype; ragged nests are refused."""
    try:
        return np.asarray(values)
    except (ValueError, TypeError, OverflowError) as error:
        raise ArgumentError(f"{name} is {short(values)}; give numbers") from error
