"""The public functions, constructors and methods of the core."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Iterator
from typing import Any

import eschorty_ros.core as core


def public_callables() -> Iterator[tuple[str, Any]]:
    """Yield ``module.function``, ``module.Class`` and ``module.Class.method`` of the core."""
    for info in pkgutil.iter_modules(core.__path__):
        if info.name.startswith("_"):
            continue
        module = importlib.import_module(f"{core.__name__}.{info.name}")
        exported = getattr(module, "__all__", ())
        for name, item in vars(module).items():
            home = getattr(item, "__module__", None)
            own = home == module.__name__ or (
                name in exported and str(home).startswith(core.__name__)
            )
            if name.startswith("_") or not own:
                continue
            if inspect.isclass(item) and not issubclass(item, Exception):
                if home == module.__name__ or f"{core.__name__}._" in str(home):
                    yield f"{info.name}.{name}", item
                    yield from _methods(f"{info.name}.{name}", item)
            elif inspect.isfunction(item) and (home == module.__name__ or "._" in str(home)):
                yield f"{info.name}.{name}", item


def _methods(prefix: str, owner: type) -> Iterator[tuple[str, Any]]:
    for name, item in vars(owner).items():
        method = inspect.isfunction(item) or isinstance(item, classmethod | staticmethod)
        if method and not name.startswith("_") and item_module(item).startswith(core.__name__):
            yield f"{prefix}.{name}", getattr(owner, name)


def item_module(item: Any) -> str:
    return str(getattr(item, "__module__", ""))


def parameters(item: Any) -> set[str]:
    """Names of the arguments a caller gives."""
    kinds = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    found = inspect.signature(item).parameters.values()
    return {p.name for p in found if p.name != "self" and p.kind not in kinds}
