"""The decorators of compiled functions: one set of options, and a cache that notices every change.

numba's cache looks at the time and size of the file a function stands in. A kernel is also made of
the kernels that it calls and of the constants it reads from other files, and an installer may keep
the time of a file. So the stamp of a kernel's cache is a digest of all of these, which have to be
defined above it.
"""

from __future__ import annotations

import builtins
import dis
import hashlib
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np
from llvmlite import ir
from llvmlite.binding import parse_assembly
from numba import njit, types
from numba.core.caching import IndexDataCacheFile
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher
from numpy.typing import NDArray


def entry_kernel(*arguments: Any, **options: Any) -> Any:
    """Compile a function that Python calls: cached, without the GIL, division as numpy divides.

    It is compiled at the first call: with ``@entry_kernel`` for the types of the arguments, with
    ``@entry_kernel(signature)`` for that signature only. Keyword options are those of
    ``numba.njit``.
    """
    if len(arguments) == 1 and hasattr(arguments[0], "__code__"):
        return _compiled(_Entry, arguments[0], options)
    if not arguments:
        return lambda function: _compiled(_Entry, function, options)
    (signature,) = arguments

    def decorated(function: Callable[..., Any]) -> Any:
        dispatcher = _compiled(_EntryOfSignature, function, options)
        dispatcher.signature = signature
        _not_loaded.append(dispatcher)
        return dispatcher

    return decorated


def kernel(*function: Any, **options: Any) -> Any:
    """Compile a function that only kernels call, else as an `entry_kernel`.

    It lacks the code that turns Python's objects into arguments, which would be a quarter of the
    time of compiling.

    ``_nrt=False`` is for kernels that make no arrays. They count no references to the arrays
    they use: each count is atomic and costs as much as a column's sums. What they call inherits it,
    but for kernels with ``_nrt=True``. A kernel that counts returns no arrays to one that does not,
    which would never release them.

    ``forceinline=True`` is for kernels that run for every column: a call copies every field of its
    arguments and results.
    """
    if not function:
        return lambda function: kernel(function, **options)
    options = {
        "no_cpython_wrapper": True,
        "no_cfunc_wrapper": True,
        "pipeline_class": _InnerCompiler,
        **options,
    }
    return _compiled(_Inner, function[0], options)


class _Kernel(CPUDispatcher):
    """A compiled function; Ctrl-C while it is compiled is an exception."""

    def compile(self, signature: Any) -> Any:
        with global_compiler_lock, _interruptible():
            return super().compile(signature)


class _Entry(_Kernel):
    """A compiled function that Python calls, and that returns no named tuple.

    numba runs Python to make one. Where that is interrupted, as by Ctrl-C, the process crashes.
    """

    def compile(self, signature: Any) -> Any:
        compiled = super().compile(signature)
        if any(_is_named(each.signature.return_type) for each in self.overloads.values()):
            name = self.py_func.__qualname__
            raise TypeError(f"{name} returns a named tuple; return a plain one")
        return compiled


class _EntryOfSignature(_Entry):
    """An entry kernel of one signature that is not loaded yet.

    To load it at import would make every command wait that shows its help.
    """

    signature: Any

    def __call__(self, *arguments: Any) -> Any:
        _load(self)
        return self(*arguments)


def _load(entry: _EntryOfSignature) -> None:
    """Load a kernel's code, or compile it; from now on numba's own call is used."""
    with global_compiler_lock:
        # Another call or thread may have done so.
        if type(entry) is _EntryOfSignature:
            entry.compile(entry.signature)
            entry.disable_compile()
            entry.__class__ = _Entry


_not_loaded: list[_EntryOfSignature] = []


def load_kernels() -> None:
    """Load, or compile, every imported kernel that has a signature; else its first call does."""
    while _not_loaded:
        _load(_not_loaded.pop())


@contextmanager
def _interruptible() -> Iterator[None]:
    """Raise after the block what interrupted a callback of LLVM in it.

    Ctrl-C while LLVM works is noticed there; ctypes drops it, and numba fails at what is missing.
    """
    dropped: list[BaseException] = []
    before = sys.unraisablehook

    def note(unraisable: Any) -> None:
        if isinstance(unraisable.exc_value, KeyboardInterrupt | SystemExit):
            dropped.append(unraisable.exc_value)
        else:
            before(unraisable)

    sys.unraisablehook = note
    try:
        yield
    finally:
        sys.unraisablehook = before
        if dropped:
            raise dropped[0] from None


def _is_named(result: types.Type) -> bool:
    """Return whether a type is a named tuple, or a tuple with one in it."""
    if not isinstance(result, types.BaseTuple):
        return False
    return isinstance(result, types.BaseNamedTuple) or any(map(_is_named, result))


class _Inner(_Kernel):
    """A compiled function without code for calls from Python, which would crash."""

    def __call__(self, *_arguments: Any) -> Any:
        raise TypeError(f"only kernels call {self.py_func.__qualname__}; make it an entry_kernel")


class _InnerCompiler(Compiler):
    """The compiler of kernels that only kernels call."""

    def define_pipelines(self) -> Any:
        state = self.state
        state.library = _InnerLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        return super().define_pipelines()


class _InnerLibrary(JITCodeLibrary):
    """Code that is optimised and made machine code in the entry kernels that use it, only there.

    numba does both in every kernel for all that it calls, which is half of the time of compiling.
    """

    def _optimize_functions(self, ll_module: Any) -> None:
        ll_module.data_layout = self._codegen._data_layout

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        # numba writes to the environment of each kernel that it compiled, by the engine.
        environments = self.create_ir_module(self.name)
        for name in (each.name for each in self._final_module.global_variables):
            if name.startswith("_ZN08NumbaEnv"):
                pointer = ir.GlobalVariable(environments, ir.IntType(8).as_pointer(), name)
                pointer.linkage = "common"
                pointer.initializer = ir.Constant(pointer.value_type, None)
        self._codegen._add_module(parse_assembly(str(environments)))
        self._finalized = True

    def serialize_using_object_code(self) -> Any:
        return self.serialize_using_bitcode()


def _compiled(kind: type[CPUDispatcher], function: Callable[..., Any], options: Any) -> Any:
    dispatcher = njit(cache=True, nogil=True, error_model="numpy", **options)(function)
    dispatcher.__class__ = kind
    # numba has no public way to say what a cached function depends on.
    index = dispatcher._cache._cache_file
    index._source_stamp = dispatcher.source_digest = _digest(function)
    index.__class__ = _Index
    return dispatcher


class _Index(IndexDataCacheFile):
    """The list of what a kernel's cache holds; empty where only an earlier version can read it."""

    def _load_index(self) -> Any:
        try:
            return super()._load_index()
        except Exception:
            # It names a type that is no more.
            self.flush()
            return {}


def _digest(function: Callable[..., Any]) -> str:
    """Return a digest of the function's file and of all it uses from other files."""
    parts = [_file_digest(function.__code__.co_filename)]
    for name in sorted(set(_names(function.__code__))):
        if name not in function.__globals__ and not hasattr(builtins, name):
            raise NameError(f"{function.__qualname__} uses {name}; define it above")
        value: Any = function.__globals__.get(name)
        if isinstance(value, ModuleType):
            if value.__name__.startswith(__name__.partition(".")[0]):
                parts.append(_file_digest(str(value.__file__)))
        elif hasattr(value, "source_digest"):
            parts.append(f"{name}={value.source_digest}")
        elif hasattr(value, "_fields"):
            parts.append(f"{name}={value._fields}")
        elif isinstance(value, bool | int | float | str | tuple | np.generic | np.ndarray):
            parts.append(f"{name}={value!r}")
    return hashlib.blake2b(";".join(parts).encode(), digest_size=16).hexdigest()


def _names(code: CodeType) -> Iterator[str]:
    """Yield the names of all globals that the code reads."""
    # dis.get_instructions would take a tenth of the start of a process that imports kernels.
    argument = 0
    for operation, low_bits in zip(code.co_code[::2], code.co_code[1::2], strict=True):
        argument = argument << 8 | low_bits
        if operation == dis.opmap["LOAD_GLOBAL"]:
            yield code.co_names[argument >> 1]
        if operation != dis.EXTENDED_ARG:
            argument = 0
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def with_names(function: Any, suffix: str, **names: Any) -> Any:
    """Return the kernel of ``function`` with other global ``names``, such as kernels it calls.

    It makes and returns no arrays. ``suffix`` distinguishes it from others of the same function.
    """
    clone = FunctionType(function.__code__, {**function.__globals__, **names})
    clone.__module__, clone.__qualname__ = function.__module__, f"{function.__qualname__}_{suffix}"
    return kernel(_nrt=False)(clone)


@cache
def _file_digest(path: str) -> str:
    return hashlib.blake2b(Path(path).read_bytes(), digest_size=16).hexdigest()


def record(*names: str, value: float = 0, numbers: NDArray[np.int64] | None = None) -> Any:
    """Return a record of fields, all ``value`` with its type, that kernels change as attributes.

    It is a view of ``numbers`` where they are given.

    >>> state = record("row", "column")
    >>> state["row"] += 3
    >>> print(state)
    (3, 0)
    """
    values = np.full(len(names), value) if numbers is None else numbers
    return values.view([(name, values.dtype) for name in names])[0]
