"""The stage's driver on the emulated controller, in one process and in virtual time."""

from __future__ import annotations

import errno
import threading
from collections.abc import Callable
from typing import Any

from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.emulation.apt.model import AptModel
from eschorty_ros.hardware.stage.apt_link import AptLink
from eschorty_ros.hardware.stage.apt_messages import Frame
from eschorty_ros.hardware.stage.apt_setup import AptSettings
from eschorty_ros.hardware.stage.apt_stage import AptStage

EPOCH_NS = 1_700_000_000_000_000_000
TICK_NS = 200_000
SUSPENSION_NS = 600_000_000


class MemoryPort:
    timeout: float | None = None
    in_waiting = 0

    def __init__(self, bench: AptBench) -> None:
        self._bench = bench
        self.written: list[tuple[int, bytes]] = []

    def write(self, data: bytes) -> int:
        if self._bench.model.gone:
            raise OSError(errno.EIO, "Input/output error")
        self.written.append((self._bench.now_ns, data))
        self._bench.model.feed(data)
        return len(data)

    def read(self, size: int = 1) -> bytes:
        return b""

    def close(self) -> None:
        pass


class AptBench:
    """Driver, ``AptModel`` with these arguments, and the clock of both.

    The controller handles nothing and sends nothing until ``halted_until_ns``. The host is
    suspended at each of the next ``suspensions`` times at which it reads its clock.
    """

    def __init__(
        self, settings: AptSettings | None = None, *, home: bool = True, **model: Any
    ) -> None:
        self.settings = settings or AptSettings()
        self.now_ns = 0
        self.clock_set_ns = 0
        self.halted_until_ns = 0
        self.suspensions = 0
        self.model = AptModel(
            self.clock_ns, controller=self.settings.controller, bay=self.settings.bay, **model
        )
        self.port = MemoryPort(self)
        self.link: AptLink | None = None
        self._due_ns = 0
        self.on_tick: Callable[[], None] = lambda: None
        self.stage = self.open()
        if home:
            self.stage.home()
            self.until(lambda: self.stage.state().homed, 30.0)

    def clock_ns(self) -> int:
        return EPOCH_NS + self.now_ns

    def host_clock_ns(self) -> int:
        """The clock by which the driver stamps, set by ``clock_set_ns``."""
        if self.suspensions:
            self.suspensions -= 1
            self.now_ns += SUSPENSION_NS
        return self.clock_ns() + self.clock_set_ns

    def open(self) -> AptStage:
        return AptStage(self._make_link, self.host_clock_ns, self.settings)

    def _make_link(
        self, on_frame: Callable[[Frame, int], None], on_lost: Callable[[DeviceError], None]
    ) -> AptLink:
        self.link = AptLink(self.port, on_frame, on_lost, lambda: self.now_ns, self._wait)
        return self.link

    def _wait(self, condition: threading.Condition, seconds: float) -> None:
        self._tick(self.now_ns + round(seconds * 1e9))

    def _tick(self, limit_ns: int) -> None:
        """Advance by a tick, or by many up to ``limit_ns`` while both sides are idle."""
        idle_ns = min(limit_ns - self.now_ns, self._idle_ns())
        self.now_ns += max(idle_ns // TICK_NS, 1) * TICK_NS
        self.on_tick()
        if self.link is not None:
            self.link.receive(b"" if self.now_ns < self.halted_until_ns else self.model.step())
            self._due_ns = self.now_ns + round(self.link.service() * 1e9)

    def _idle_ns(self) -> int:
        if self.link is None:
            return TICK_NS
        if self.model._in._sent or self.model._out._sent:
            return 0
        to_end_ns = self.model.axis.plan.end_ns - self.clock_ns()
        to_due_ns = self._due_ns - self.now_ns
        return min(to_due_ns, to_end_ns) if to_end_ns > 0 else to_due_ns

    def advance(self, seconds: float) -> None:
        end_ns = self.now_ns + round(seconds * 1e9)
        while self.now_ns < end_ns:
            self._tick(end_ns)

    def until(self, condition: Callable[[], bool], limit_s: float = 10.0) -> None:
        end_ns = self.now_ns + round(limit_s * 1e9)
        while not condition():
            assert self.now_ns < end_ns, f"not within {limit_s:g} s"
            self._tick(end_ns)

    def move(self, position_mm: float, speed_mm_s: float = 200.0) -> None:
        self.stage.move_to(position_mm, speed_mm_s)
        self.until(lambda: not self.stage.state().moving, 60.0)

    def failure(self, limit_s: float = 5.0) -> str:
        """Return the error that the user reads when the stage fails."""
        errors: list[str] = []

        def failed() -> bool:
            try:
                self.stage.state()
            except DeviceError as error:
                errors.append(str(error))
            return bool(errors)

        self.until(failed, limit_s)
        assert "\n" not in errors[0]
        return errors[0]

    @property
    def true_mm(self) -> float:
        return self.model.axis.position_mm(self.clock_ns())

    def sent(self, name_id: int) -> list[int]:
        """Return when (ns) the host wrote messages of an identifier."""
        return [at for at, data in self.port.written if data[:2] == name_id.to_bytes(2, "little")]
