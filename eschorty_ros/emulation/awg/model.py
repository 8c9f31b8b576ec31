"""A UTG900E-like waveform generator on an emulated USB bus, with its failures.

Like the family it replies without a newline, never answers a request where no reply is due, locks
the front panel at any command until ``:SYSTem:LOCK OFF``, silently ignores a value out of range,
and has no error queue unless given one. Unconfirmed on hardware: everything after ``*RST`` and
power-up, that a load reads back as scaled volts, and all of the burst. A burst of counted cycles
begins at ``*TRG`` with a rising edge; a trigger while it runs begins the count again at the last
cycle, without a change of the waveform (``burst_trigger``).
"""

from __future__ import annotations

import re
import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

from eschorty_ros.core.modulation import FREQUENCY_MAX_HZ, FREQUENCY_MIN_HZ, Modulation
from eschorty_ros.emulation.awg.commands import ChannelState, Command, find_command, match_keyword
from eschorty_ros.emulation.awg.faults import AwgFaults
from eschorty_ros.emulation.bus.usb_device import (
    SPEED_FULL,
    EmulatedUsbDevice,
    EndpointIdentity,
    UsbIdentity,
    Wait,
)

VENDOR_ID, PRODUCT_ID = 0x6656, 0x0834
ENDPOINT_OUT, ENDPOINT_IN = 0x01, 0x81
PACKET = 64
CHANNELS = 2
THRESHOLD_V = 2.0
"""Level at which a TTL laser input is on."""

_REMEMBERED = 4096
_HEADER = struct.Struct("<BBBBIB3x")
_WAVEFORMS = {"SQUARE": "square", "PULSE": "pulse", "SINE": "sine"}
_CLASS_INTERFACE_IN = 0xA1
_CHANNEL = re.compile(r":?CHAN(?:nel)?([12]?):(.+)", re.I)
_LOCK = re.compile(r":?SYST(?:em)?:LOCK", re.I)
_ERROR = re.compile(r":?SYST(?:em)?:ERR(?:or)?", re.I)

OnChange = Callable[[int, bool, Modulation], None]


class AwgModel(EmulatedUsbDevice):
    """The generator; channel 1 modulates the laser.

    - ``clock_ns``: Clock of ``on_change``, ns.
    - ``log_path``: File for a line ``<CLOCK_MONOTONIC ns> ON|OFF`` at power-up and each time the
      waveform starts or stops at output 1, before the command is answered.
    - ``wait``: As for ``EmulatedUsbDevice``.
    - ``steady_ns``: Clock of the bursts, ns.

    Public attributes:
    - ``burst_trigger``: What a trigger does while a burst runs: ``extends``, ``restarts`` or
      ``ignored``; empty for a generator without bursts.
    - ``locked``: True while the front panel is locked.
    - ``errors``: The error queue; ``None`` by default, because the family has none.
    - ``commands``: The last 4096 commands received, in order.
    - ``on_change``: ``on_change(since_ns, lit, modulation)`` at each change of the light or its
      modulation; ``since_ns`` is the time of a rising edge.
    """

    def __init__(
        self,
        clock_ns: Callable[[], int],
        log_path: str | Path | None = None,
        *,
        serial: str = "AWG1234567890",
        wait: Wait = threading.Condition.wait,
        steady_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        identity = UsbIdentity(
            vendor_id=VENDOR_ID,
            product_id=PRODUCT_ID,
            interface_class=0xFE,
            interface_subclass=0x03,
            interface_protocol=0x01,
            endpoints=(
                EndpointIdentity(ENDPOINT_OUT, PACKET),
                EndpointIdentity(ENDPOINT_IN, PACKET),
            ),
            serial=serial,
            manufacturer="UNI-T",
            product="UTG962E",
            speed=SPEED_FULL,
        )
        super().__init__(identity, wait=wait)
        self._clock_ns = clock_ns
        self._steady_ns = steady_ns
        self.burst_trigger = "extends"
        # Start and end of channel 1's burst, steady; none runs after its end.
        self._burst_ns = (0, 0)
        self._burst_runs = self._burst_awaited = False
        self._log_path = None if log_path is None else Path(log_path)
        self.faults = AwgFaults()
        self.errors: deque[str] | None = None
        self.commands: deque[str] = deque(maxlen=_REMEMBERED)
        self.on_change: OnChange | None = None
        self._logged: bool | None = None
        self._light: tuple[bool, Modulation] | None = None
        self._message = b""
        self._replies: deque[bytes] = deque()
        self._reset_settings()

    @property
    def output(self) -> bool:
        """Return whether output 1 is switched on."""
        return self.channels[0].output

    @property
    def running(self) -> bool:
        """Return whether output 1 is on with its waveform, in a burst or continuous."""
        state = self.channels[0]
        return state.output and (state.mode != "BURST" or self._burst_runs)

    @property
    def lit(self) -> bool:
        """Return whether output 1 reaches the level at which the laser is on."""
        state = self.channels[0]
        level_v = max(state.high_v, state.low_v) if self.running else state.idle_v
        return state.output and level_v >= THRESHOLD_V

    def power_up(self) -> None:
        """Start: outputs off, factory settings, panel unlocked."""
        super().power_up()
        self._reset_settings()

    def reboot(self) -> None:
        """Restart without leaving the bus, as after a brown-out."""
        with self.mutex:
            self.power_up()

    def touch(self, path: str, text: str, channel: int = 1) -> bool:
        """Set a value at the front panel; returns False when it is locked."""
        with self.mutex:
            command = find_command(path)
            if self.locked or command is None:
                return False
            self._put(command, self.channels[channel - 1], text)
            return True

    def end_burst(self) -> float:
        """End a burst whose cycles are done; return the time until its end, s, 0 without one."""
        with self.mutex:
            if not self._burst_runs:
                return 0.0
            left_ns = self._burst_ns[1] - self._steady_ns()
            if left_ns <= 0:
                self._burst_runs = False
                # The instrument is punctual, also where this process is not.
                self._changed(late_ns=-left_ns)
            return max(left_ns * 1e-9, 0.0)

    def _trigger(self) -> None:
        state, now_ns = self.channels[0], self._steady_ns()
        counted = (state.mode, state.burst_type, state.burst_source) == ("BURST", "NCYC", "MANUAL")
        if not counted or not state.output or not self.burst_trigger:
            return
        self.end_burst()
        cycle_ns = 1e9 / state.frequency_hz
        begin_ns = now_ns
        if self._burst_runs and self.burst_trigger == "ignored":
            return
        if self._burst_runs and self.burst_trigger == "extends":
            begin_ns = now_ns - round((now_ns - self._burst_ns[0]) % cycle_ns)
        elif self._burst_runs:
            self._burst_runs = False
            self._changed()
        self._burst_ns = (begin_ns, begin_ns + round(state.burst_cycles * cycle_ns))
        if not self._burst_runs:
            self._burst_runs = True
            self._changed()
        if not self._burst_awaited:
            self._burst_awaited = True
            threading.Thread(target=self._await_end, name="burst", daemon=True).start()

    def _await_end(self) -> None:
        while True:
            with self.mutex:
                left_s = self.end_burst()
                self._burst_awaited = left_s > 0.0
            if not left_s:
                return
            time.sleep(min(left_s, 0.1))

    def bulk_out(self, endpoint: int, data: bytes, timeout_ms: int) -> int:
        """Receive a message, or a request for a reply."""
        kind, tag, inverse, _, size, attributes = _HEADER.unpack_from(data)
        if tag == 0 or inverse != tag ^ 0xFF:
            self.stalled.add(endpoint)
        elif kind == 1:
            self._message += data[_HEADER.size : _HEADER.size + size]
            if attributes & 1:
                message, self._message = self._message, b""
                self._execute(message.decode("ascii", "replace"))
        elif kind == 2:
            self._answer(tag, size)
        return len(data)

    def control(
        self,
        request_type: int,
        request: int,
        value: int,
        index: int,
        data: bytes | int,
        timeout_ms: int,
    ) -> bytes | int:
        """Answer INITIATE_CLEAR and CHECK_CLEAR, and the standard requests."""
        if request_type == _CLASS_INTERFACE_IN and request == 5 and not self.faults.no_clear:
            self._message = b""
            self._replies.clear()
            self._pipes[ENDPOINT_IN].clear()
            return b"\x01"
        if request_type == _CLASS_INTERFACE_IN and request == 6:
            return b"\x02\x00" if self.faults.take("pending_clears") else b"\x01\x00"
        return super().control(request_type, request, value, index, data, timeout_ms)

    def reset(self) -> None:
        """Reset the bus: messages in progress are dropped, the settings stay."""
        super().reset()
        self._message = b""
        self._replies.clear()

    def _reset_settings(self) -> None:
        self.channels = [ChannelState() for _ in range(CHANNELS)]
        self._burst_runs = False
        self.locked = False
        self._message = b""
        self._replies.clear()
        self._changed()

    def _execute(self, message: str) -> None:
        self.locked = True
        for text in filter(None, (part.strip() for part in re.split(r"[;\n]", message))):
            self.commands.append(text)
            path, _, parameter = text.partition(" ")
            if path.endswith("?"):
                reply = self._queried(path[:-1])
                if reply is not None:
                    self._replies.append(reply.encode("ascii") + b"\n" * self.faults.newline)
            else:
                self._set(path, parameter.strip())

    def _queried(self, path: str) -> str | None:
        if path.upper() == "*IDN":
            return f"UNI-T,UTG962E,{self.identity.serial},V1.08"
        if _LOCK.fullmatch(path):
            return "ON" if self.locked else "OFF"
        if _ERROR.fullmatch(path):
            if self.errors is None:
                return None
            return self.errors.popleft() if self.errors else '0,"No error"'
        found = _CHANNEL.fullmatch(path)
        command = find_command(found[2]) if found else None
        return command.show(self._channel(found)) if found and command else None

    def _set(self, path: str, parameter: str) -> None:
        if path.upper() == "*RST":
            self._reset_settings()
            self.locked = True
        elif path.upper() == "*TRG":
            self._trigger()
        elif _LOCK.fullmatch(path):
            self.locked = parameter.upper() in ("ON", "1")
        found = _CHANNEL.fullmatch(path)
        command = find_command(found[2]) if found else None
        if found and command and command.path not in self.faults.ignored:
            parameter = self.faults.changed.get(command.path, parameter)
            if command.path == "MODe" and match_keyword(("BURSt",), parameter):
                parameter *= bool(self.burst_trigger)
            self._put(command, self._channel(found), parameter)

    def _put(self, command: Command, state: ChannelState, text: str) -> None:
        command.put(state, text)
        # Switching off, and every change of the wave, ends a burst.
        self._burst_runs &= self.output and command.path == "OUTPut"
        self._changed()

    def _channel(self, found: re.Match[str]) -> ChannelState:
        return self.channels[int(found[1] or 1) - 1]

    def _answer(self, tag: int, requested: int) -> None:
        """Send the reply that is due, if there is one, in one transfer."""
        faults = self.faults
        if not self._replies or faults.take("late_replies"):
            return
        if faults.take("lost_replies"):
            self._replies.popleft()
            return
        reply = self._replies.popleft()
        most = min(requested, faults.transfer_bytes or requested)
        part, rest = reply[:most], reply[most:]
        if rest:
            self._replies.appendleft(rest)
        if faults.take("wrong_tags"):
            tag = tag % 255 + 1
        kind = 3 if faults.take("wrong_kinds") else 2
        size = len(part) + (100 if faults.take("oversized") else 0)
        data = _HEADER.pack(kind, tag, tag ^ 0xFF, 0, size, 0 if rest else 1) + part
        if faults.take("empty_packets"):
            self.reply(ENDPOINT_IN, b"")
        self.reply(ENDPOINT_IN, data[:7] if faults.take("short_headers") else data)

    def _changed(self, late_ns: int = 0) -> None:
        """Log a start or stop of output 1, and call ``on_change`` with the light."""
        if self.running is not self._logged:
            self._logged = self.running
            if self._log_path is not None:
                with self._log_path.open("a", encoding="ascii") as log:
                    log.write(
                        f"{time.monotonic_ns() - late_ns} {'ON' if self.running else 'OFF'}\n"
                    )
        light = (self.lit, self.modulation())
        if self.on_change is not None and light != self._light:
            self.on_change(self._clock_ns(), *light)
        self._light = light

    def modulation(self) -> Modulation:
        """Return the modulation of channel 1, the nearest one that a laser can have."""
        state = self.channels[0]
        frequency_hz = min(max(state.frequency_hz, FREQUENCY_MIN_HZ), FREQUENCY_MAX_HZ)
        waveform = _WAVEFORMS.get(state.wave, "square")
        duty = 0.5 if waveform == "sine" else state.duty_percent / 100.0
        return Modulation(frequency_hz, 1.0 - duty if state.inversion else duty, waveform)
