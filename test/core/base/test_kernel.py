"""Compiled code is as new as all that it was made of."""

import os
import subprocess
import sys

CALLEE = """
from eschorty_ros.core.base.kernel import kernel

FACTOR = {factor}

@kernel
def _scaled(x):
    return {scale} * x
"""
CALLER = """
from callee import FACTOR, _scaled
from eschorty_ros.core.base.kernel import entry_kernel

@entry_kernel
def _total(x):
    return _scaled(x) + FACTOR

@entry_kernel('int64(int64)')
def _early_total(x):
    return _scaled(x) + FACTOR

print(_total(1), _early_total(1))
"""
KEPT = """
import numpy as np
from eschorty_ros.core.base.kernel import kernel

@kernel
def _root(x):
    if x < 0:
        raise ValueError("negative")
    return np.sqrt(np.full(3, x)).sum()
"""
KEEPING = """
from callee import _root
from eschorty_ros.core.base.kernel import entry_kernel

@entry_kernel
def _scaled(x):
    return {factor} * _root(x)

try:
    _scaled(-1.0)
except ValueError as error:
    print(f"{{_scaled(1.0):.0f}} raised", error)
"""
INTERRUPTED = """
from llvmlite.binding import executionengine
from eschorty_ros.core.base.kernel import entry_kernel

@entry_kernel
def _doubled(x):
    return 2 * x

def interrupt(*_):
    raise KeyboardInterrupt

string_at, executionengine.string_at = executionengine.string_at, interrupt
try:
    _doubled(1)
except KeyboardInterrupt:
    print("interrupted")
executionengine.string_at = string_at
print(_doubled(1))
"""


def output(tmp_path, *command):
    """What Python prints, with the modules and the kernels' cache of this folder."""
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path]),
        "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
    }
    command = [sys.executable, "-B", *command]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_change_in_another_file_reaches_the_kernels_that_use_it(tmp_path):
    """Time and size of every file stay as they were, as after some installers."""
    (tmp_path / "caller.py").write_text(CALLER)

    def result(factor, scale):
        callee = tmp_path / "callee.py"
        callee.write_text(CALLEE.format(factor=factor, scale=scale))
        os.utime(callee, (0, 0))
        return output(tmp_path, str(tmp_path / "caller.py"))

    assert result(factor=10, scale=2) == "12 12\n"
    assert result(factor=20, scale=2) == "22 22\n"
    assert result(factor=20, scale=3) == "23 23\n"
    assert len(list(tmp_path.glob("cache/*/*_total*.nbi"))) == 2


def test_a_kept_kernel_is_used_by_a_new_one(tmp_path):
    (tmp_path / "callee.py").write_text(KEPT)
    for factor, seen in ((2, "6 raised"), (3, "9 raised")):
        (tmp_path / "caller.py").write_text(KEEPING.format(factor=factor))
        assert output(tmp_path, str(tmp_path / "caller.py")) == f"{seen} negative\n"
    kept = [each.name for each in (tmp_path / "cache").rglob("*.nbc")]
    assert sum("_root" in name for name in kept) == 1, kept


def test_an_argument_type_that_exists_no_more_does_not_break_the_cache(tmp_path):
    """The cache's index refers to argument types by module and name."""
    code = """
from typing import NamedTuple
from eschorty_ros.core.base.kernel import entry_kernel

class {name}(NamedTuple):
    first: int
    second: int

@entry_kernel
def _sum(pair):
    return pair.first + pair.second
"""
    for name in ("Pair", "Renamed"):
        (tmp_path / "pairs.py").write_text(code.format(name=name))
        call = f"from pairs import _sum, {name}; print(_sum({name}(1, 2)))"
        assert output(tmp_path, "-c", call) == "3\n"


def test_a_kernel_uses_nothing_that_is_defined_below_it(tmp_path):
    """Its cache would not notice a change there."""
    code = """
from eschorty_ros.core.base.kernel import kernel

@kernel
def _total(x):
    return _scaled(x)

@kernel
def _scaled(x):
    return 2 * x
"""
    (tmp_path / "below.py").write_text(code)
    call = "try:\n    import below\nexcept NameError as error:\n    print(error)"
    assert output(tmp_path, "-c", call) == "_total uses _scaled; define it above\n"


def test_a_kernel_that_only_kernels_call_refuses_a_call_from_python(tmp_path):
    """It would crash; also one that comes from the cache, in the second process."""
    (tmp_path / "callee.py").write_text(CALLEE.format(factor=10, scale=2))
    (tmp_path / "caller.py").write_text(CALLER)
    call = (
        "import caller\ntry:\n    caller._scaled(1)\nexcept TypeError as error:\n    print(error)"
    )
    for _ in range(2):
        assert output(tmp_path, "-c", call) == (
            "12 12\nonly kernels call _scaled; make it an entry_kernel\n"
        )


POINTED = """
from typing import NamedTuple

from eschorty_ros.core.base.kernel import entry_kernel, kernel
from eschorty_ros.core.base.pointer import Pointer

@entry_kernel
def _checked(x):
    if x > 2:
        raise ValueError(f"{x} is too much")
    return True

class Called(NamedTuple):
    check: Pointer

@kernel(_nrt=False)
def _count(x, called):
    for i in range(x):
        if not called.check(i):
            return i
    return x

@entry_kernel
def _counted(x, called):
    return _count(x, called)

called = Called(Pointer(_checked, 1))
print(_counted(2, called), _counted(9, called))
"""


def test_a_kernel_called_by_its_address_returns_false_where_it_raises(tmp_path):
    """Also one that comes from the cache, in the second process."""
    (tmp_path / "pointed.py").write_text(POINTED)
    for _ in range(2):
        printed = output(tmp_path, str(tmp_path / "pointed.py"))
        assert printed == "2 3\n"


def test_boxed_arrays_are_compiled_once():
    """The kernel's cache refers to types of modules that import it, so that it is read late."""
    code = """
import eschorty_ros as es
from eschorty_ros.core.base.boxed import _box
from eschorty_ros.core.evt3 import Decoder

es.Reconstructor(es.load_calibration("config_3"), es.Modulation(70.0))
Decoder().boxed
print(len(_box().stats.cache_misses))
"""
    command = [sys.executable, "-c", code]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    results = [
        subprocess.run(command, env=environment, capture_output=True, text=True) for _ in range(2)
    ]
    assert results[1].stdout == "0\n", results[1].stderr


def test_kernels_are_loaded_when_they_are_called_by_several_threads_or_all_at_once(tmp_path):
    code = """
from concurrent.futures import ThreadPoolExecutor
from eschorty_ros.core.base.kernel import entry_kernel, load_kernels

@entry_kernel("int64(int64)")
def _doubled(x):
    return 2 * x

@entry_kernel("int64(int64)")
def _tripled(x):
    return 3 * x

print(*ThreadPoolExecutor(4).map(_doubled, range(4)), len(_tripled.overloads))
load_kernels()
print(len(_tripled.overloads))
"""
    (tmp_path / "shared.py").write_text(code)
    assert output(tmp_path, str(tmp_path / "shared.py")) == "0 2 4 6 0\n1\n"


def test_help_compiles_nothing(tmp_path):
    code = "from eschorty_ros.cli import main; main(['reconstruct', '--help'])"
    assert "Example" in output(tmp_path, "-c", code)
    assert not list(tmp_path.rglob("*.nb?"))


def test_a_kernel_that_python_calls_returns_no_named_tuple(tmp_path):
    """numba makes one in a way that an interrupt at that moment turns into a crash."""
    code = """
from typing import NamedTuple
from eschorty_ros.core.base.kernel import entry_kernel

class Pair(NamedTuple):
    first: int
    second: int

@entry_kernel
def _pair(n):
    return 1, {result}

try:
    print(_pair(2))
except TypeError as error:
    print(error)
"""
    results = {"(n, n)": "(1, (2, 2))", "Pair(n, n)": "_pair returns a named tuple"}
    for result, words in results.items():
        (tmp_path / "pairs.py").write_text(code.format(result=result))
        assert words in output(tmp_path, str(tmp_path / "pairs.py"))


def test_ctrl_c_while_a_kernel_is_compiled_is_an_exception(tmp_path):
    """In the callback by which LLVM hands over its code."""
    (tmp_path / "interrupted.py").write_text(INTERRUPTED)
    assert output(tmp_path, str(tmp_path / "interrupted.py")) == "interrupted\n2\n"
