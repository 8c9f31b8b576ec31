"""A request to a service that is repeated until an answer comes."""

from __future__ import annotations

import math
import time
from typing import Any

RESEND_S = 2.0


class RepeatedCall:
    """A request that is sent by ``done`` and, with ``again``, repeated every 2 s.

    A server may receive a request before it has discovered the receiver of its answer.
    A repeated request may be carried out twice.
    """

    def __init__(self, client: Any, request: Any, *, again: bool) -> None:
        self._client, self._request, self._again = client, request, again
        self._futures: list[Any] = []
        self._sent_s = -math.inf

    def done(self) -> bool:
        """Send the request if it is due; return whether an answer has come."""
        due = self._again and time.monotonic() - self._sent_s > RESEND_S
        if due or not self._futures:
            self._sent_s = time.monotonic()
            self._futures.append(self._client.call_async(self._request))
        return any(future.done() for future in self._futures)

    def result(self) -> Any:
        """Return the answer."""
        return next(future.result() for future in self._futures if future.done())
