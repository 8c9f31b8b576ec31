"""Hostile values by kind of argument, and calls that take them."""

import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

HUGE = 10**400


@dataclass(frozen=True)
class Kind:
    """Values an argument must refuse, and values it may take or refuse."""

    refused: Sequence[Any]
    borderline: Sequence[Any] = ()
    nan_gives_nan: bool = False


@dataclass(frozen=True)
class Call:
    """One public callable: how to call it, valid arguments, and what else each may be."""

    make: Callable[..., Any]
    good: dict[str, Any]
    kinds: dict[str, Kind] = field(default_factory=dict)


def number(low: float = -math.inf, high: float = math.inf, *, optional: bool = False) -> Kind:
    """A finite scalar; ``low`` and ``high`` are the first values outside or absent."""
    wrong: list[Any] = [math.nan, math.inf, -math.inf, "3", 1 + 2j, [1.0, 2.0], HUGE]
    wrong += [bound for bound in (low, high) if math.isfinite(bound)]
    return Kind(wrong + ([] if optional else [None]), [1e300, -1e300, 5e-324, np.float32(3.0)])


def number_or_nan(*outside: float) -> Kind:
    wrong: list[Any] = [math.inf, -math.inf, "3", 1 + 2j, [1.0, 2.0], HUGE, None, *outside]
    return Kind(wrong, [math.nan, 1e300, 5e-324])


def integer(low: int | None = None, high: int | None = None, *, optional: bool = False) -> Kind:
    """An integer; ``low`` and ``high`` are the first values outside or absent."""
    wrong: list[Any] = [math.nan, math.inf, 1.5, "3", [1, 2], HUGE]
    wrong += [bound for bound in (low, high) if bound is not None]
    return Kind(wrong + ([] if optional else [None]), [np.int64(3), 2**62, -(2**62)])


def text() -> Kind:
    return Kind(["no such name", "", 3, None, math.nan, ["mean"]])


_NO_REALS: list[Any] = ["abc", ["a", "b"], None, [None], [[1.0], [1.0, 2.0]], object()]
_NO_REALS += [np.array([1 + 1j])]


def reals(*, optional: bool = False) -> Kind:
    """Real numbers of any shape; NaN in, NaN out."""
    rows = np.arange(12.0).reshape(3, 4)
    return Kind(
        [value for value in _NO_REALS if not optional or value is not None],
        [math.inf, -math.inf, 1e308, -1e308, 5e-324, [], np.zeros((2, 0, 3)), rows[:, ::2], HUGE],
        nan_gives_nan=True,
    )


def vector(*outside: float, finite: bool = True, size: int = 0) -> Kind:
    """One axis of real numbers, of ``size`` entries where that is given."""
    infinite = (math.nan, math.inf, -math.inf) if finite else ()
    wrong = [*_NO_REALS, np.zeros((2, 2)), *_full(size, (*outside, *infinite))]
    return Kind(wrong, [np.arange(float(2 * size))[::2]] if size else [[]])


def integers(*outside: int, size: int = 0, any_shape: bool = False) -> Kind:
    wrong: list[Any] = [[1.5] * max(size, 1), [math.nan], "abc", ["a"], None]
    wrong += [] if any_shape else [np.zeros((2, 2), int)]
    wrong += [np.array([HUGE]), [1 + 1j], *_full(size, outside)]
    return Kind(wrong, [np.arange(2 * size)[::2]] if size else [[]])


def _full(size: int, values: Sequence[Any]) -> list[Any]:
    return [np.full(max(size, 1), value) for value in values]


def exactly(dtype: str, size: int) -> Kind:
    """An array that compiled code takes as it is: dtype and shape must be right."""
    good = np.zeros(size, dtype)
    wrong: list[Any] = [good.astype("f4"), np.zeros((2, 2), dtype), good[:-1], None, "abc", 3]
    return Kind(wrong, [np.zeros(2 * size, dtype)[::2]])


def stream() -> Kind:
    rng = np.random.default_rng(26)
    noise = [rng.integers(0, 256, n, np.uint8).tobytes() for n in (1, 7, 5000)]
    return Kind(["text", None, 3, [1, 2], np.zeros(3)], [b"", bytearray(b"ab"), *noise])


def path() -> Kind:
    return Kind([None, 3, "no/such/folder/file.pcd", "a\0b.pcd", "/"])


def parameters(item: Any) -> set[str]:
    """Names of the arguments a caller gives."""
    variable = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    found = inspect.signature(item).parameters.values()
    return {p.name for p in found if p.name != "self" and p.kind not in variable}
