"""A brushless stage controller over APT: bytes in, bytes out, in the time of its clock.

Its answers follow the protocol description, not the driver: the layouts are shared data, and the
tests check those against thorlabs-apt-protocol. Behaviour that no source describes is the simplest:
a move while another is under way is ignored, a homed axis reads 0 at its lower end. Where a source
leaves open when a setting counts, it counts at the latest: a sequence of pulses is the one that was
set when the output was switched to it.
"""

from __future__ import annotations

from collections.abc import Callable

from eschorty_ros.core.clocks.motion import MotionPlan
from eschorty_ros.emulation.apt.axis import EMERGENCY_MM_S2, Axis
from eschorty_ros.emulation.apt.frames import CommandParser, pack_answer
from eschorty_ros.emulation.apt.memory import SETTINGS, Memory
from eschorty_ros.emulation.apt.wire import Disturbance, Wire
from eschorty_ros.hardware.stage import apt_messages as apt

# Status messages sent after the last keep-alive; then nothing is sent until the next one.
_UNACKNOWLEDGED_MAX = 50
_STATUSES = ("status", "moved", "stopped")


class AptModel:
    """KBD101 or BBD30x with a DDS220.

    Not thread-safe: hold a lock around ``feed`` and ``step``.

    - ``controller``: ``kbd101`` or ``bbd30x``.
    - ``bay``: Bay of the rack that holds the axis, from 1.
    - ``travel_mm``: Hard ends of the carriage.
    - ``power_up_mm``: Position of the carriage at power-up; the encoder reads 0 there.
    - ``speed_max_mm_s``, ``acceleration_max_mm_s2``: Limits that the stage data report and the
      controller applies.
    - ``late_ns``: Extra delay of each frame to the host, as a USB adapter adds.
    - ``on_plan``: Called with every new motion, in the clock's time.
    - ``sampled_pulses``: Trigger pulses begin at the next cycle of 102.4 us, as a KBD101's do.
    - ``reserved_bytes``: Reserved bytes at the end of its answers about the trigger.
    - ``seed``: Seed of random disturbances.

    Public attributes:
    - ``axis``: The carriage.
    - ``disturbance``: Faults of its bytes.
    - ``gone``, ``mute``, ``panel_disabled``, ``ignores_moves``: Unplugged; never answers; cannot be
      enabled; accepts moves without moving.
    - ``extra_bits``: Status bits set on top.
    - ``withheld``: Names of messages it never sends.
    - ``ignored``: Names of settings it does not take.
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
        late_ns: Callable[[], int] | None = None,
        on_plan: Callable[[MotionPlan], None] | None = None,
        sampled_pulses: bool = False,
        reserved_bytes: int = 12,
        seed: int = 0,
    ) -> None:
        self.scale = apt.Scale()
        self.serial = 28_000_001 if controller == "kbd101" else 103_000_001
        self.gone = self.mute = self.panel_disabled = self.ignores_moves = False
        self.extra_bits = 0
        self.withheld: set[str] = set()
        self.ignored: set[str] = set()
        self.disturbance = Disturbance(seed)
        self.axis = Axis(
            clock_ns(), power_up_mm, travel_mm, on_plan or (lambda plan: None), sampled_pulses
        )
        self._clock_ns = clock_ns
        self._rack = controller == "bbd30x"
        self._bay = bay
        self._address = apt.bay_address(bay) if self._rack else apt.SINGLE_UNIT
        self._limits = (speed_max_mm_s, acceleration_max_mm_s2)
        self._in = Wire()
        self._out = Wire(late_ns)
        self._commands = CommandParser()
        self._reserved_bytes = reserved_bytes
        self._memory = Memory(self.scale, self._rack)
        self._power_up()

    def _power_up(self) -> None:
        self.enabled = self.homed = False
        self._memory.reset()
        self._ending = ""
        self._unacknowledged = 0

    def reboot(self) -> None:
        """Lose power for a short time: settings, bits and counters are as at power-up."""
        now_ns = self._clock_ns()
        self.axis.stop(now_ns, EMERGENCY_MM_S2)
        self._power_up()
        self.axis.begin_pulses(now_ns, None)
        self.axis.encoder_offset_mm = self.axis.position_mm(now_ns)

    @property
    def resting(self) -> bool:
        """Return whether no motion is under way, and no byte."""
        return not (self._in or self._out or self._ending)

    def trigger_pulses(self, from_ns: int, until_ns: int) -> list[tuple[int, bool]]:
        """Return the trigger edges from ``from_ns`` to before ``until_ns``: time, rising."""
        return self.axis.pulses(from_ns, until_ns)

    def feed(self, data: bytes) -> None:
        """Begin to receive bytes of the host, one after the other."""
        if not self.gone:
            for byte in data:
                self._in.send(bytes((byte,)), self._clock_ns())

    def step(self) -> bytes:
        """Advance to now; return the bytes that reach the host."""
        if self.gone:
            return b""
        now_ns = self._clock_ns()
        for at_ns, data in self._in.receive(now_ns):
            for name, address, values in self._commands.feed(data):
                self._handle(name, address, values, at_ns)
        self._complete(now_ns)
        return b"".join(data for _, data in self._out.receive(now_ns))

    def send_error(self, code: int, text: str = "") -> None:
        """Send an unrequested error message; the long form with ``text``."""
        if text:
            self._send("error_text", message=0, code=code, text=text.encode())
        else:
            self._send("error")

    # What the host sends

    def _handle(self, name: str, address: int, values: dict[str, int], at_ns: int) -> None:
        self._complete(at_ns)
        if name == "request_bay" and self._rack and address == apt.RACK:
            occupied = 1 if values["bay"] == self._bay - 1 else 2
            self._send("bay", apt.RACK, at_ns, bay=values["bay"], state=occupied)
        elif name == "set_rack_port" and address in (apt.RACK, apt.SINGLE_UNIT):
            self._set(name, values, at_ns)
        elif name == "request_info" and (address == self._address or address == apt.RACK):
            self._send_info(address, at_ns)
        elif address == self._address:
            self._handle_axis(name, values, at_ns)

    def _handle_axis(self, name: str, values: dict[str, int], at_ns: int) -> None:
        match name:
            case "keep_alive":
                self._unacknowledged = 0
            case "set_enabled":
                self.enabled = values["state"] == 1 and not self.panel_disabled
                if not self.enabled:
                    self.axis.stop(at_ns, EMERGENCY_MM_S2)
            case "home" | "move_absolute" | "stop":
                self._motion(name, values, at_ns)
            case "set_rack_trigger" if values["channel"] != self._bay:
                pass  # The number of the motor channel in this one, 1 in all others.
            case _ if name in SETTINGS:
                self._set(name, values, at_ns)
            case _:
                self._answer(name, at_ns)

    def _set(self, name: str, values: dict[str, int], at_ns: int) -> None:
        mode = self._memory.position_mode
        if name not in self.ignored:
            self._memory.set(name.removeprefix("set_"), values)
        if self._memory.position_mode != mode:
            self.axis.begin_pulses(at_ns, self._memory.sequence)

    def _motion(self, name: str, values: dict[str, int], at_ns: int) -> None:
        # A motion begins now, not when its command came: its past was reported already.
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
            self.axis.zero_encoder(end_ns)
            self._send("homed", at_ns=end_ns, channel=1)
        else:
            self._send_status(ended, end_ns)

    # What the controller sends

    def _answer(self, name: str, at_ns: int) -> None:
        match name:
            case "request_status":
                self._send_status("status", at_ns)
            case "request_axis":
                self._send_axis(at_ns)
            case "request_velocity" | "request_ports" | "request_pulses" | "request_rack_trigger":
                kind = name.removeprefix("request_")
                values = self._memory.get(kind)
                if values is not None:
                    self._send(kind, at_ns=at_ns, **values)

    def _send_info(self, address: int, at_ns: int) -> None:
        model = b"BBD301" if self._rack else b"KBD101"
        values = {"serial": self.serial, "type": 45 if address == apt.RACK else 44}
        versions = {"minor": 4, "interim": 1, "major": 2, "hardware": 1, "modification": 0}
        self._send("info", address, at_ns, model=model, notes=b"", channels=1, **values, **versions)

    def _send_axis(self, at_ns: int) -> None:
        scale, (low, high), (speed, acceleration) = self.scale, self.axis.travel_mm, self._limits
        self._send(
            "axis",
            at_ns=at_ns,
            channel=1,
            part=b"DDS220",
            serial=45_000_001,
            counts_per_unit=round(scale.counts_per_mm),
            maximum=scale.position(high - low),
            acceleration=scale.acceleration(acceleration),
            deceleration=scale.acceleration(EMERGENCY_MM_S2),
            velocity=scale.velocity(speed),
        )

    def _send_status(self, name: str, at_ns: int) -> None:
        velocity = self.axis.velocity_mm_s(at_ns) * self.scale.counts_per_mm * self.scale.cycle_s
        self._send(
            name,
            at_ns=at_ns,
            channel=1,
            position=round(self.axis.encoder_mm(at_ns) * self.scale.counts_per_mm),
            velocity=round(velocity),
            current=0,
            bits=self._bits(at_ns),
        )

    def _bits(self, at_ns: int) -> int:
        # Motor connected, power ok; homing; homed; tracking, enabled.
        bits = 0x1000_0100
        bits |= 0x200 if self._ending == "homed" else 0
        bits |= apt.HOMED if self.homed else 0
        bits |= 0x1000 | apt.ENABLED if self.enabled else 0
        return self.extra_bits | bits | self.axis.bits(at_ns, bool(self._ending), self.enabled)

    def _send(
        self, name: str, source: int = 0, at_ns: int | None = None, **values: int | bytes
    ) -> None:
        halted = self._unacknowledged >= _UNACKNOWLEDGED_MAX
        if self.mute or halted or name in self.withheld:
            return
        self._unacknowledged += name in _STATUSES
        frame = pack_answer(
            name, source or self._address, reserved_bytes=self._reserved_bytes, **values
        )
        self._out.send(self.disturbance.apply(frame), self._clock_ns() if at_ns is None else at_ns)
