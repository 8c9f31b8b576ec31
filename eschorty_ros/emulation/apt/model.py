"""A brushless stage controller that speaks APT: bytes in, bytes out, in the time of its clock.

What it answers follows the protocol description, not the driver: the layouts are shared data, and
the tests check those against thorlabs-apt-protocol. Behaviour that no source settles is the
simplest one: a move while another is under way is ignored, a homed axis reads 0 at its lower end.
"""

from __future__ import annotations

from collections.abc import Callable

from eschorty_ros.core.clocks import MotionPlan
from eschorty_ros.emulation.apt.axis import EMERGENCY_MM_S2, Axis, stage_data
from eschorty_ros.emulation.apt.frames import HostFrames, answer
from eschorty_ros.emulation.apt.memory import ASKING, SETTING, Memory
from eschorty_ros.emulation.apt.wire import BYTE_NS, Disturbance, Wire
from eschorty_ros.hardware.stage import apt_messages as apt

UPDATE_NS = 100_000_000
SILENT_AFTER = 50
CONTROLLERS = ("kbd101", "bbd30x")


class AptModel:
    """KBD101 or BBD30x with a DDS220.

    Not thread-safe: whoever serves it holds a lock around ``feed`` and ``step``.

    Parameters
    ----------
    clock_ns : callable
    controller : {"kbd101", "bbd30x"}
    bay : int
        Bay of the rack that holds the axis, from 1.
    travel_mm : tuple of float
        Hard ends of the carriage.
    power_up_mm : float
        Where the carriage stands at power-up; the encoder reads 0 there.
    speed_max_mm_s, acceleration_max_mm_s2 : float
        What the stage data report and the controller obeys.
    byte_ns : int
        Time of one byte on the line; 0 for an infinitely fast one.
    late_ns : callable, optional
        Extra delay of each frame to the host, as a USB adapter adds.
    on_plan : callable, optional
        Told every new motion, in the clock's time.
    sampled_pulses : bool
        Whether trigger pulses begin at the next cycle of 102.4 us, as a KBD101's do.
    seed : int
        Of drawn disturbances.

    Attributes
    ----------
    axis : Axis
        The carriage.
    disturbance : Disturbance
        What happens to its bytes.
    gone, mute, panel_disabled, ignores_moves : bool
        Unplugged; hears but never answers; cannot be enabled; accepts moves without moving.
    extra_bits : int
        Status bits set on top.
    withheld : set of str
        Names of messages it never sends.
    """

    def __init__(
        self,
        clock_ns: Callable[[], int],
        *,
        controller: str = "kbd101",
        bay: int = 1,
        travel_mm: tuple[float, float] = (0.0, 220.0),
        power_up_mm: float = 5.0,
        speed_max_mm_s: float = 250.0,
        acceleration_max_mm_s2: float = 2000.0,
        byte_ns: int = BYTE_NS,
        late_ns: Callable[[], int] | None = None,
        on_plan: Callable[[MotionPlan], None] | None = None,
        sampled_pulses: bool = False,
        seed: int = 0,
    ) -> None:
        assert controller in CONTROLLERS
        self.scale = apt.Scale()
        self.serial = 28_000_001 if controller == "kbd101" else 103_000_001
        self.gone = self.mute = self.panel_disabled = self.ignores_moves = False
        self.extra_bits = 0
        self.withheld: set[str] = set()
        self.disturbance = Disturbance(seed)
        self.axis = Axis(
            clock_ns(), power_up_mm, travel_mm, on_plan or (lambda plan: None), sampled_pulses
        )
        self._clock_ns = clock_ns
        self._rack = controller == "bbd30x"
        self._bay = bay
        self._address = apt.bay_address(bay) if self._rack else apt.SINGLE_UNIT
        self._limits = (speed_max_mm_s, acceleration_max_mm_s2)
        self._in = Wire(byte_ns)
        self._out = Wire(byte_ns, late_ns)
        self._commands = HostFrames()
        self._memory = Memory(self.scale, self._rack)
        self._power_up()

    def _power_up(self) -> None:
        self.enabled = self.homed = False
        self._memory.forget()
        self._ending = ""
        self._updates_ns: int | None = None
        self._unacknowledged = 0

    def reboot(self) -> None:
        """Lose power for a moment: settings, bits and counters are as at power-up."""
        now_ns = self._clock_ns()
        self.axis.stop(now_ns, EMERGENCY_MM_S2)
        self._power_up()
        self.axis.encoder_offset_mm = self.axis.position_mm(now_ns)
        self.axis.pattern = self._memory.pattern

    def plan(self) -> MotionPlan:
        """Tell the motion under way or the rest after it, in the clock's time."""
        return self.axis.plan

    def trigger_pulses(self, from_ns: int, until_ns: int) -> list[tuple[int, bool]]:
        """Edges of the trigger output from ``from_ns`` to before ``until_ns``: time, rising."""
        return self.axis.pulses(from_ns, until_ns)

    def feed(self, data: bytes) -> None:
        """Take bytes of the host; they arrive one after the other from now on."""
        if not self.gone:
            for byte in data:
                self._in.put(bytes((byte,)), self._clock_ns())

    def step(self) -> bytes:
        """Carry on until now; the bytes the host gets."""
        if self.gone:
            return b""
        now_ns = self._clock_ns()
        for at_ns, data in self._in.take(now_ns):
            for name, address, values in self._commands.feed(data):
                self._obey(name, address, values, at_ns)
        self._complete(now_ns)
        while self._updates_ns is not None and self._updates_ns <= now_ns:
            self._say_status("status", self._updates_ns)
            self._updates_ns += UPDATE_NS
        return b"".join(data for _, data in self._out.take(now_ns))

    def next_ns(self) -> int | None:
        """Time at which ``step`` has something to do next."""
        moving = self.axis.plan.end_ns if self._ending else None
        due = [self._in.next_ns, self._out.next_ns, self._updates_ns, moving]
        return min((at_ns for at_ns in due if at_ns is not None), default=None)

    def complain(self, code: int, text: str = "") -> None:
        """Send an error message nobody asked for; the long form with ``text``."""
        if text:
            self._say("error_text", message=0, code=code, text=text.encode())
        else:
            self._say("error")

    # What the host sends

    def _obey(self, name: str, address: int, values: dict[str, int], at_ns: int) -> None:
        self._complete(at_ns)
        if name == "request_bay" and self._rack and address == apt.RACK:
            occupied = 1 if values["bay"] == self._bay - 1 else 2
            self._say("bay", apt.RACK, at_ns, bay=values["bay"], state=occupied)
        elif name == "set_rack_port" and address in (apt.RACK, apt.SINGLE_UNIT):
            self._set(name, values)
        elif name == "request_info" and (address == self._address or address == apt.RACK):
            self._tell_info(address, at_ns)
        elif address == self._address:
            self._obey_axis(name, values, at_ns)

    def _obey_axis(self, name: str, values: dict[str, int], at_ns: int) -> None:
        match name:
            case "keep_alive":
                self._unacknowledged = 0
            case "start_updates":
                self._updates_ns = at_ns + UPDATE_NS
            case "stop_updates":
                self._updates_ns = None
            case "set_enabled":
                self.enabled = values["state"] == 1 and not self.panel_disabled
                if not self.enabled:
                    self.axis.stop(at_ns, EMERGENCY_MM_S2)
            case "home" | "move_absolute" | "stop":
                self._motion(name, values, at_ns)
            case _ if name in SETTING:
                self._set(name, values)
            case _:
                self._answer(name, at_ns)

    def _set(self, name: str, values: dict[str, int]) -> None:
        self._memory.keep(name.removeprefix("set_"), values)
        self.axis.pattern = self._memory.pattern

    def _motion(self, name: str, values: dict[str, int], at_ns: int) -> None:
        # A motion begins now, not when its command came: the past has been told already.
        at_ns = max(at_ns, self._clock_ns())
        speed = min(self._memory.speed_mm_s, self._limits[0])
        acceleration = min(self._memory.acceleration_mm_s2, self._limits[1])
        if name == "stop":
            if self._ending:
                self._ending = "stopped"
            self.axis.stop(at_ns, EMERGENCY_MM_S2 if values["mode"] == 1 else acceleration)
            return
        if not self.enabled or self._ending or self.ignores_moves or self.axis.stalled:
            return
        if name == "home":
            self.homed = False
            speed = min(self._memory.homing_mm_s, speed)
            target = self.axis.travel_mm[0]
        else:
            target = self.scale.mm(values["position"]) + self.axis.encoder_offset_mm
        self._ending = "homed" if name == "home" else "moved"
        self.axis.move(at_ns, target, speed, acceleration)

    def _complete(self, now_ns: int) -> None:
        if not self._ending or self.axis.moving(now_ns) or self.axis.stalled:
            return
        ended, self._ending = self._ending, ""
        end_ns = self.axis.plan.end_ns
        if ended == "homed":
            self.homed = True
            self.axis.encoder_offset_mm = self.axis.travel_mm[0]
            self._say("homed", at_ns=end_ns, channel=1)
        else:
            self._say_status(ended, end_ns)

    # What the controller sends

    def _answer(self, name: str, at_ns: int) -> None:
        match name:
            case "request_status":
                self._say_status("status", at_ns)
            case "request_axis":
                self._tell_axis(at_ns)
            case "request_enabled":
                self._say("enabled", at_ns=at_ns, channel=1, state=1 if self.enabled else 2)
            case _ if name in ASKING:
                kind = name.removeprefix("request_")
                values = self._memory.kept(kind)
                if values is not None:
                    reply = "home_parameters" if kind == "home" else kind
                    self._say(reply, at_ns=at_ns, **values)

    def _tell_info(self, address: int, at_ns: int) -> None:
        model = b"BBD301" if self._rack else b"KBD101"
        values = {"serial": self.serial, "type": 45 if address == apt.RACK else 44}
        versions = {"minor": 4, "interim": 1, "major": 2, "hardware": 1, "modification": 0}
        self._say("info", address, at_ns, model=model, notes=b"", channels=1, **values, **versions)

    def _tell_axis(self, at_ns: int) -> None:
        low, high = self.axis.travel_mm
        self._say("axis", 0, at_ns, **stage_data(high - low, *self._limits, self.scale))

    def _say_status(self, name: str, at_ns: int) -> None:
        self._unacknowledged += 1
        if self._unacknowledged > SILENT_AFTER:
            return
        velocity = self.axis.velocity_mm_s(at_ns) * self.scale.counts_per_mm * self.scale.cycle_s
        self._say(
            name,
            at_ns=at_ns,
            channel=1,
            position=round(self.axis.encoder_mm(at_ns) * self.scale.counts_per_mm),
            velocity=round(velocity),
            current=0,
            bits=self._bits(at_ns),
        )

    def _bits(self, at_ns: int) -> int:
        ending = self._ending
        return (
            self.extra_bits
            | self.axis.bits(at_ns, bool(ending), self.enabled)
            | sum(
                mask
                for mask, holds in (
                    (0x0000_0100, True),
                    (0x0000_0200, ending == "homed"),
                    (0x0000_0400, self.homed),
                    (0x0000_1000, self.enabled),
                    (0x1000_0000, True),
                    (0x8000_0000, self.enabled),
                )
                if holds
            )
        )

    def _say(
        self, name: str, source: int = 0, at_ns: int | None = None, **values: int | bytes
    ) -> None:
        if self.mute or name in self.withheld:
            return
        frame = self.disturbance.apply(answer(name, source or self._address, **values))
        self._out.put(frame, self._clock_ns() if at_ns is None else at_ns)
