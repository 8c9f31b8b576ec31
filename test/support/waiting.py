"""Waiting for what another thread or process does; no ROS."""

import time
from collections.abc import Callable
from typing import Any

DEADLINE_S = 120.0
"""Of whatever is waited for: only what never comes takes so long, on slow machines too."""


def wait_until(
    condition: Callable[[], Any], what: str, deadline_s: float = DEADLINE_S, poll_s: float = 0.02
) -> Any:
    """The first truthy value of ``condition()``; fails with ``what`` after ``deadline_s``."""
    end_s = time.monotonic() + deadline_s
    while True:
        value = condition()
        if value:
            return value
        if time.monotonic() > end_s:
            raise AssertionError(f"not within {deadline_s:g} s: {what}")
        time.sleep(poll_s)
