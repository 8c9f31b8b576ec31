"""What docstrings show and promise holds."""

import ast
import doctest
import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = sorted((ROOT / "eschorty_ros").rglob("*.py"))
WITH_EXAMPLES = [path for path in SOURCES if "\n    >>> " in path.read_text()]


def _module(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


@pytest.mark.parametrize("path", WITH_EXAMPLES, ids=_module)
def test_examples_give_what_they_show(path: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    failed, tried = doctest.testmod(importlib.import_module(_module(path)))
    assert tried > 0
    assert failed == 0


@pytest.mark.parametrize(
    "part",
    ["core.optics", "core.evt3", "core.line", "core.reconstruction", "core.calibration"],
)
def test_the_parts_that_users_call_show_an_example(part: str) -> None:
    assert any(_module(path).startswith(f"eschorty_ros.{part}") for path in WITH_EXAMPLES)


def test_public_functions_are_annotated() -> None:
    """mypy leaves this to the test: kernels, which are private, are typed by numba."""
    bare = []
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
                arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
                named = [a for a in arguments if a.arg not in ("self", "cls")]
                if node.returns is None or any(a.annotation is None for a in named):
                    bare.append(f"{path.relative_to(ROOT)}:{node.lineno} {node.name}")
    assert not bare
