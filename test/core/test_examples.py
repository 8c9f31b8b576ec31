"""The examples in docstrings run and give what they show."""

from __future__ import annotations

import doctest
import importlib
import inspect
import pkgutil

import pytest

import eschorty_ros.core as core

MODULES = [
    module
    for info in pkgutil.walk_packages(core.__path__, f"{core.__name__}.")
    if ">>> " in inspect.getsource(module := importlib.import_module(info.name))
]


@pytest.mark.parametrize("module", MODULES, ids=lambda module: module.__name__)
def test_examples_of_a_module(module):
    failed, attempted = doctest.testmod(module)
    assert attempted > 0
    assert failed == 0
