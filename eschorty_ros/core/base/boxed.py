"""Many arrays as one argument of a compiled function.

At every call numba takes a tuple of arrays apart, which costs as much as a packet's events where
there are a hundred of them. Boxed arrays are taken apart once.
"""

from __future__ import annotations

from _thread import allocate_lock, start_new_thread
from functools import cache
from typing import Any

from numba import types
from numba.experimental import structref

from eschorty_ros.core.base.kernel import entry_kernel


@structref.register
class _BoxedType(types.StructRef):
    """Type of `Boxed` in compiled functions."""


class Boxed(structref.StructRefProxy):
    """A named tuple, whose fields a compiled function reads from ``content``."""

    def __new__(cls, content: Any) -> Boxed:
        """Return ``content`` boxed."""
        # numba makes an object by Python's code, and does not see that a signal interrupts this.
        # Signals interrupt the main thread alone, and a bare lock as the one wait without a fault.
        results: list[Boxed | BaseException] = []
        done = allocate_lock()
        done.acquire()

        def box() -> None:
            try:
                results.append(_box()(content))
            except BaseException as error:
                results.append(error)
            done.release()

        start_new_thread(box, ())
        done.acquire()
        boxed = results[0]
        if isinstance(boxed, BaseException):
            raise boxed
        return boxed


structref.define_boxing(_BoxedType, Boxed)
structref.define_constructor(Boxed, _BoxedType, ["content"])


@cache
def _box() -> Any:
    """Return the kernel that boxes; made late, as its cache refers to the types of all contents."""

    @entry_kernel
    def _boxed(content):
        return Boxed(content)

    return _boxed
