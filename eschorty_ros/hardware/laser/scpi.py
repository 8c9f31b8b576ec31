"""SCPI over a message link: one command per message, replies parsed, one retry after recovery."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from typing import TypeVar

from eschorty_ros.core.base.errors import DeviceError, DeviceGoneError
from eschorty_ros.hardware.laser.awg_profile import AwgProfile, Value, keyword_forms
from eschorty_ros.hardware.laser.in_flight import VoidedError
from eschorty_ros.hardware.laser.usbtmc import UsbTmc

Result = TypeVar("Result")

_ERRORS_DRAINED = 32
_NUMBER = re.compile(r"([-+]?\d*\.?\d+(?:[eE][-+]?\d+)?)\s*([A-Za-z%]*)", re.ASCII)


class Scpi:
    """Settings of one channel of one generator.

    Every command is absolute and may be sent twice: after a fault the link is cleared and the
    command is sent once more; a second fault is raised.

    - ``refuse_void``: Called before every transfer; raises to give up.
    - ``counters``: ``faults`` counts transfers that failed, ``retries`` those sent once more.
    """

    def __init__(
        self,
        link: UsbTmc,
        profile: AwgProfile,
        refuse_void: Callable[[], None],
        counters: dict[str, int],
    ) -> None:
        self._link = link
        self._profile = profile
        self._refuse_void = refuse_void
        self._counters = counters

    def set(self, name: str, value: Value, channel: int) -> None:
        """Set ``name`` (a key of the profile's ``settings``); raises ``DeviceError``."""
        self.command(self.spelt(name, value, channel))

    def get(self, name: str, channel: int) -> Value:
        """Return the value of ``name``: bool, float or keyword, by its kind.

        Raises ``DeviceError`` for no reply, and for two that are no value of that kind.
        """
        query = self._profile.settings[name].command.format(channel=channel) + "?"
        return self._attempt(lambda: self._parsed(name, query, self._ask(query)))

    def command(self, text: str) -> None:
        """Send a command without a reply; raises ``DeviceError``."""
        self._attempt(lambda: self._write(text))

    def ask(self, text: str) -> str:
        """Send a query, return its reply without line ends; raises ``DeviceError``."""
        return self._attempt(lambda: self._ask(text))

    def message(self, text: str) -> bytes:
        """Return the message of one command."""
        return (text + self._profile.terminator).encode("ascii")

    def drain_errors(self) -> list[str]:
        """Empty the error queue and return its entries, none when the generator has no queue.

        At most 32, without a retry: no reply or garbage mean that there is no queue, not a fault.
        """
        query = self._profile.error_queue
        if query is None:
            return []
        found: list[str] = []
        for _ in range(_ERRORS_DRAINED):
            self._refuse_void()
            try:
                reply = self._ask(query)
            except (DeviceGoneError, VoidedError):
                raise
            except DeviceError:
                # If it fails, so does the next command, which clears it once more.
                with suppress(DeviceError):
                    self._link.clear()
                return []
            match = re.match(r"\s*([-+]?\d+)\s*(,.*)?$", reply)
            if match is None:
                return []
            if int(match[1]) == 0:
                break
            found.append(reply)
        return found

    def spelt(self, name: str, value: Value, channel: int) -> str:
        """Return the command that sets ``name``."""
        setting = self._profile.settings[name]
        setting.check(name, value)
        if isinstance(value, bool):
            value = setting.on if value else setting.off
        return f"{setting.command.format(channel=channel)} {_text(value)}"

    def _attempt(self, step: Callable[[], Result]) -> Result:
        retried = False
        while True:
            self._refuse_void()
            try:
                return step()
            except (DeviceGoneError, VoidedError):
                raise
            except DeviceError:
                self._counters["faults"] += 1
                self._refuse_void()
                self._link.clear()
                if retried:
                    raise
            retried = True
            self._counters["retries"] += 1

    def _write(self, text: str) -> None:
        self._link.write(self.message(text))

    def _ask(self, text: str) -> str:
        self._write(text)
        self._refuse_void()
        reply = self._link.read()
        try:
            return reply.decode("ascii").strip("\r\n \0")
        except UnicodeDecodeError:
            raise DeviceError(
                f"{text} was answered with {reply[:20]!r}, which is no text; check cable and hub"
            ) from None

    def _parsed(self, name: str, query: str, reply: str) -> Value:
        setting, replies = self._profile.settings[name], self._profile.replies
        word = reply.strip("\"' ").upper()
        if setting.kind == "switch":
            if word in (*replies.on, *keyword_forms(setting.on)):
                return True
            if word in (*replies.off, *keyword_forms(setting.off)):
                return False
        elif setting.kind == "number":
            match = _NUMBER.fullmatch(reply)
            scales = {"": 1.0, **replies.units}
            if match is not None and match[2] in scales:
                return float(match[1]) * scales[match[2]]
        elif re.fullmatch(r"[A-Z][A-Z0-9]*", word):
            return word
        raise DeviceError(
            f"{query} was answered with {reply[:40]!r}, which is no {setting.kind}; "
            "check that the profile fits the generator"
        )


def _text(value: float | str) -> str:
    """Return a value as SCPI text: plain decimals, no exponents."""
    if isinstance(value, str):
        return value.upper()
    return f"{value:.9f}".rstrip("0").rstrip(".")
