"""Fault plans: a YAML file that says what goes wrong with which device, and when.

faults:
- {device: camera, fault: unplug, at: {after_bytes: 2_000_000}, for_s: 1.5}
- {device: laser, fault: changed, target: "BASE:FREQuency=19999", at: {on_message: "FREQ"}}
- {device: stage, fault: lost_bytes, amount: 7, at: {after_s: 4.0}}
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from pydantic import Field, model_validator

from eschorty_ros.core.errors import FormatError
from eschorty_ros.core.yaml_file import Schema, read_yaml, validate
from eschorty_ros.emulation.fault_catalogue import CATALOGUE, Dose, Kind, recognises

_POLL_S = 0.01


class Moment(Schema):
    """When a fault begins; exactly one of these.

    Parameters
    ----------
    after_s : float
        Seconds after the plan was set going.
    after_transfers, after_bytes : int
        Transfers or bytes of the device since then, both ways.
    on_message : str
        Right after the host sent this: part of a command (laser), a register that is written
        (camera, hex), a message id (stage, hex).
    """

    after_s: float | None = Field(None, ge=0.0, le=86_400.0)
    after_transfers: int | None = Field(None, ge=0)
    after_bytes: int | None = Field(None, ge=0)
    on_message: str | None = Field(None, min_length=1)

    @model_validator(mode="after")
    def _exactly_one(self) -> Moment:
        if len(self.model_fields_set) != 1 or None in (
            getattr(self, name) for name in self.model_fields_set
        ):
            raise ValueError(
                "give exactly one of after_s, after_transfers, after_bytes, on_message"
            )
        return self


class PlannedFault(Schema):
    """One fault of a plan.

    Parameters
    ----------
    device : {"camera", "laser", "stage"}
    fault : str
        A name of the device's catalogue.
    at : Moment
    for_s : float, optional
        It is taken back after so many seconds; without, it stays or ends by itself.
    amount : int
        How many or how much; what it counts is said in the catalogue.
    target : str
        What it is about, where the catalogue says so.
    """

    device: Literal["camera", "laser", "stage"]
    fault: str
    at: Moment
    for_s: float | None = Field(None, gt=0.0, le=86_400.0)
    amount: int = Field(1, ge=1, le=1 << 31)
    target: str = ""

    @model_validator(mode="after")
    def _in_the_catalogue(self) -> PlannedFault:
        kinds = CATALOGUE[self.device]
        if self.fault not in kinds:
            raise ValueError(f"fault {self.fault!r} is unknown; choose one of {', '.join(kinds)}")
        if self.for_s is not None and kinds[self.fault].end is None:
            raise ValueError(f"{self.fault} ends by itself; leave for_s out")
        if kinds[self.fault].needs_target and not self.target:
            raise ValueError(f"{self.fault} needs a target: {kinds[self.fault].means}")
        if self.at.on_message is not None and self.device != "laser":
            self._check_hex(self.at.on_message)
        return self

    @staticmethod
    def _check_hex(text: str) -> None:
        try:
            int(text, 16)
        except ValueError:
            raise ValueError(f"on_message {text!r} is no hexadecimal number") from None

    @property
    def kind(self) -> Kind:
        """Its entry in the catalogue."""
        return CATALOGUE[self.device][self.fault]


class FaultPlan(Schema):
    """What is to go wrong."""

    faults: list[PlannedFault]


def load_fault_plan(path: str | os.PathLike[str]) -> FaultPlan:
    """Read a plan.

    Raises
    ------
    FormatError
        For a file that is no such plan, with one line for the first fault in it.
    """
    return validate(FaultPlan, read_yaml(path, FormatError), path, FormatError)


@dataclass
class _Counter:
    transfers: int = 0
    bytes: int = 0


class ObservedLine:
    """A serial model whose bytes count for a plan.

    Its faults begin inside ``feed`` and ``step``, in the thread that serves the model.
    """

    def __init__(self, model: Any, script: FaultScript):
        self._model = model
        self._script = script

    @property
    def gone(self) -> bool:
        """Whether the model is unplugged; nobody serves it then, and its return is decided here."""
        if self._model.gone:
            self._script.step("stage")
        return bool(self._model.gone)

    @gone.setter
    def gone(self, value: bool) -> None:
        self._model.gone = value

    def feed(self, data: bytes) -> None:
        """Hand bytes of the host to the model."""
        self._model.feed(data)
        self._script.transferred("stage", data, from_host=True)

    def step(self) -> bytes:
        """Let the model go on; its bytes to the host."""
        data: bytes = self._model.step()
        if data:
            self._script.transferred("stage", data, from_host=False)
        else:
            self._script.step("stage")
        return data


class FaultScript:
    """Carries a plan out on the models; as a context also while nothing is transferred.

    Parameters
    ----------
    plan : FaultPlan
    devices : mapping
        Models by ``camera``, ``laser``, ``stage``. The stage is to be served through ``line``.
    clock_ns : callable

    Attributes
    ----------
    begun : list of (int, PlannedFault)
        What has begun so far, with its time (ns).
    """

    def __init__(self, plan: FaultPlan, devices: Mapping[str, Any], clock_ns: Callable[[], int]):
        self._devices = dict(devices)
        self._clock_ns = clock_ns
        self._start_ns = clock_ns()
        self._lock = threading.Lock()
        self._waiting = [fault for fault in plan.faults if fault.device in devices]
        self._ending: list[tuple[int, PlannedFault]] = []
        self._counters = {name: _Counter() for name in devices}
        self._over = threading.Event()
        self.begun: list[tuple[int, PlannedFault]] = []
        for name in ("camera", "laser"):
            if name in devices:
                devices[name].on_transfer = self._listener(name)

    def __enter__(self) -> FaultScript:
        threading.Thread(target=self._run, name="fault-script", daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()

    def line(self) -> ObservedLine:
        """Give the stage as it is to be served."""
        return ObservedLine(self._devices["stage"], self)

    def transferred(self, device: str, data: bytes, *, from_host: bool) -> None:
        """Count a transfer and begin what is due by it."""
        with self._lock:
            counter = self._counters[device]
            counter.transfers += 1
            counter.bytes += len(data)
        self.step(device, data if from_host else b"")

    def step(self, device: str, heard: bytes = b"") -> None:
        """Begin and end what is due for a device now."""
        if not self._waiting and not self._ending:
            return
        now_ns = self._clock_ns()
        with self._lock:
            due = [f for f in self._waiting if f.device == device and self._due(f, now_ns, heard)]
            over = [f for at_ns, f in self._ending if f.device == device and at_ns <= now_ns]
            self._waiting = [fault for fault in self._waiting if fault not in due]
            self._ending = [e for e in self._ending if e[1] not in over]
            for fault in due:
                self.begun.append((now_ns, fault))
        # Outside the lock: models have locks of their own and tell of transfers under them.
        model = self._devices[device]
        for fault in due:
            fault.kind.begin(model, Dose(fault.amount, fault.target, now_ns))
            if fault.for_s is not None:
                # Only now: another thread ends what is over.
                with self._lock:
                    self._ending.append((now_ns + round(fault.for_s * 1e9), fault))
        for fault in over:
            if fault.kind.end:
                fault.kind.end(model, Dose(fault.amount, fault.target, now_ns))

    def _due(self, fault: PlannedFault, now_ns: int, heard: bytes) -> bool:
        at, counter = fault.at, self._counters[fault.device]
        if at.after_s is not None:
            return now_ns - self._start_ns >= at.after_s * 1e9
        if at.after_transfers is not None:
            return counter.transfers >= at.after_transfers
        if at.after_bytes is not None:
            return counter.bytes >= at.after_bytes
        return bool(heard) and recognises(fault.device, at.on_message or "", heard)

    def _listener(self, device: str) -> Callable[[int, bytes], None]:
        def listen(endpoint: int, data: bytes) -> None:
            self.transferred(device, data, from_host=not endpoint & 0x80)

        return listen

    def _run(self) -> None:
        while not self._over.wait(_POLL_S):
            for name in ("camera", "laser"):
                if name in self._devices:
                    self.step(name)
