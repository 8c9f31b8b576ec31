"""The border of a node: what a message may hold, and what is counted when it holds more."""

from __future__ import annotations

import math
import time
import traceback
from collections import Counter
from typing import Any

from rclpy.node import Node
from rclpy.subscription import Subscription

from eschorty_ros.core.base.errors import ArgumentError, EschortyError

_LOG_S = 5.0
_LINE_MAX = 300
_TEXT_MAX = 200
UINT32_MAX, UINT64_MAX = (1 << 32) - 1, (1 << 64) - 1


class Refusals:
    """Messages of a node that were refused, and errors of its callbacks: counted and logged.

    The log has one line per name every 5 s.

    Public attributes:
    - ``counts``: Their numbers by name.
    - ``last``: Name and reason of the last one.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._logged_s: dict[str, float] = {}
        self.counts: Counter[str] = Counter()
        self.last = ""

    def add(self, name: str, reason: str) -> None:
        """Count what came by ``name``; log the reason when that is due."""
        self.counts[name] += 1
        self.last = f"{name}: {reason[:_LINE_MAX]}"
        now_s = time.monotonic()
        if now_s - self._logged_s.get(name, -math.inf) < _LOG_S:
            return
        self._logged_s[name] = now_s
        self._node.get_logger().error(f"{self.last} ({self.counts[name]} so far)")

    def values(self) -> dict[str, int]:
        """Return the counts for ``/diagnostics``."""
        return {f"refused {name}": count for name, count in sorted(self.counts.items())}


def refusals(node: Node) -> Refusals:
    """Return the refusals of a node."""
    found: Refusals = node.__dict__.setdefault("_refusals", Refusals(node))
    return found


def note_error(node: Node, entity: Any, error: Exception) -> None:
    """Count and log what a callback of ``entity`` raised."""
    # After a signal every use of the context fails.
    if not node.context.ok():
        return
    name = _name(node, entity)
    if isinstance(error, EschortyError) and isinstance(entity, Subscription):
        refusals(node).add(name, str(error))
    else:
        where = traceback.extract_tb(error.__traceback__)[-1]
        refusals(node).add(name, f"{error!r} at {where.filename}:{where.lineno}")


def _name(node: Node, entity: Any) -> str:
    full = getattr(entity, "topic_name", None) or getattr(entity, "srv_name", None)
    if full is None:
        return type(entity).__name__
    return str(full).removeprefix(f"{node.get_namespace()}/")


def check_text(name: str, text: str) -> str:
    """Return an identifier unless it is longer than 200 characters."""
    if len(text) > _TEXT_MAX:
        raise ArgumentError(f"{name} has {len(text)} characters; send {_TEXT_MAX} at most")
    return text


def saturated(count: float, limit: int = UINT64_MAX) -> int:
    """Return a count as a message's field of this limit can hold it."""
    return min(max(int(count), 0), limit)
