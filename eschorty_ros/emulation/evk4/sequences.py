"""The register sequences that an IMX636 in an EVK4 expects, and a check of their order.

Source: openeb 5.1.1 (imx636_evk3_issd.h), confirmed by neuromorphic-rs; separate from the driver's
tables, so that an error in either one shows. That the camera requires the order is
*unconfirmed on hardware*.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

# Hexadecimal address=value in order; a[m]=v changes the bits of mask m alone; /.../ is a wait.
_TEXTS = {
    "init": """
        1C=1 /1s/ 400004=1 /500ms/ 400004=0 /1s/
        B000=158 /300us/ B044=0 B004=A B040=0 B0C8=0 B040=0 B040=0 0=4F006442 0=F006442 B8=400
        B8=400 B07C=0 B074=2 B078=A0 C0=110 C0=210 B120=1 E120=0 B068=4 B07C=1 /10us/ B07C=3 /1ms/
        B8=401 B8=409 0=4F006442 0=4F00644A B080=77 B084=F B088=37 B08C=37 B090=DF B094=57 B098=37
        B09C=67 B0A0=37 B0A4=2F B0AC=28 B0CC=1
        B000=2F8 B004=8A B01C=30 B020=2000 B02C=FF B030=3E80 B028=FA0
        A000=B0501 /200us/ A008=2405 /200us/ A004=B0501 /200us/ A020=150 /200us/
        B040=7 B064=6 B040=F /100us/ B004=8A /200us/ B0C8=3 /200us/ B044=1 B000=2F9
        7008=1 7000=70001 8000=1E085 9008=644 4=F0005042 18=200 1014=11A1504D 9004=0 /1ms/ 9000=200
    """,
    "start": "B000=2F9 9028=0 9008[1]=1 2C=22C724 4[400]=400",
    "stop": "4[400]=0 2C=22C324 9028=2 /1ms/ 9008[1]=0 B000=2F8 /300us/",
    "destroy": """
        70=400008 6C=EE47114 /500us/ A00C=20400 /500us/ A010=8068 /200us/ 1104=0 /200us/
        A020=50 /200us/ A004=B0500 /200us/ A008=2404 /200us/ A000=B0500
        B044=0 B004=A B040=E B0C8=0 B040=6 B040=4 0=4F006442 0=F006442 B8=401 B8=400 B07C=0
    """,
}

_TOKEN = re.compile(
    r"(?P<address>[0-9A-F]+)(?:\[(?P<mask>[0-9A-F]+)\])?=(?P<value>[0-9A-F]+)"
    r"|/(?P<wait>\d+)(?P<unit>s|ms|us)/"
)
_UNIT_NS = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000}
_ALL = 0xFFFFFFFF


@dataclass(slots=True)
class Step:
    """One write of a sequence and the wait after it."""

    address: int
    mask: int
    value: int
    wait_ns: int = 0

    def matches(self, address: int, before: int, after: int) -> bool:
        """Return whether a write that changed ``before`` to ``after`` is this step."""
        untouched = self.mask == _ALL or not (before ^ after) & ~self.mask
        return address == self.address and after & self.mask == self.value and untouched

    def __str__(self) -> str:
        mask = "" if self.mask == _ALL else f"[{self.mask:X}]"
        return f"{self.address:X}{mask}={self.value:X}"


def _parse(text: str) -> tuple[Step, ...]:
    steps: list[Step] = []
    for token in _TOKEN.finditer(text):
        if token["wait"]:
            steps[-1].wait_ns = int(token["wait"]) * _UNIT_NS[token["unit"]]
        else:
            mask = int(token["mask"], 16) if token["mask"] else _ALL
            steps.append(Step(int(token["address"], 16), mask, int(token["value"], 16)))
    return tuple(steps)


SEQUENCES = {name: _parse(text) for name, text in _TEXTS.items()}


class Phase(Enum):
    """State of the sensor."""

    OFF = "off"
    READY = "initialised"
    STREAMING = "streaming"


class SequenceWatch:
    """Follows every register write and recognises complete sequences.

    - ``clock_ns``: With a clock the waits of the sequences are checked, too.

    Public attributes:
    - ``violations``: Broken sequences, sequences in the wrong phase, short waits.
    """

    def __init__(self, clock_ns: Callable[[], int] | None):
        self._clock_ns = clock_ns
        self.phase = Phase.OFF
        self.violations: list[str] = []
        self._done = dict.fromkeys(SEQUENCES, 0)
        self._wait: tuple[str, int] | None = None

    def reset(self) -> None:
        """Discard incomplete sequences and go off, as at power-up."""
        self.phase = Phase.OFF
        self._done = dict.fromkeys(SEQUENCES, 0)
        self._wait = None

    def sensor_reset(self) -> None:
        """Go off because the sensor was reset, as the initialisation does."""
        self._refuse("reset", Phase.STREAMING)
        self.phase = Phase.OFF

    def wrote(self, address: int, before: int, after: int) -> str | None:
        """Record a write; returns the name of the sequence that it completed."""
        self._check_wait()
        completed = None
        for name, steps in SEQUENCES.items():
            done = self._done[name]
            if not steps[done].matches(address, before, after):
                # One matching step is no sequence: settings and other sequences share registers.
                if done > 1:
                    came = f"{address:X}={after:X} came"
                    self.violations.append(
                        f"{name} step {done + 1}: {steps[done]} expected, {came}"
                    )
                done = 0
                if not steps[0].matches(address, before, after):
                    self._done[name] = 0
                    continue
            self._expect_wait(f"{name} step {done + 1}", steps[done].wait_ns)
            self._done[name] = (done + 1) % len(steps)
            if done + 1 == len(steps):
                completed = name
        if completed:
            self._complete(completed)
        return completed

    def _expect_wait(self, where: str, wait_ns: int) -> None:
        if wait_ns and self._clock_ns:
            self._wait = (f"{where}: wait {wait_ns / 1e3:g} us", self._clock_ns() + wait_ns)

    def _check_wait(self) -> None:
        if self._wait and self._clock_ns:
            text, until_ns = self._wait
            short_ns = until_ns - self._clock_ns()
            if short_ns > 0:
                self.violations.append(f"{text} was {short_ns / 1e3:g} us too short")
        self._wait = None

    def _complete(self, name: str) -> None:
        if name == "init":
            self.phase = Phase.READY
        elif name == "start":
            self._refuse(name, Phase.OFF, Phase.STREAMING)
            if self.phase is Phase.READY:
                self.phase = Phase.STREAMING
        elif name == "stop":
            if self.phase is Phase.STREAMING:
                self.phase = Phase.READY
        else:
            self._refuse(name, Phase.STREAMING)
            self.phase = Phase.OFF

    def _refuse(self, name: str, *phases: Phase) -> None:
        if self.phase in phases:
            self.violations.append(f"{name} while {self.phase.value}")
