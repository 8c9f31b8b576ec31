"""A Prophesee EVK4 on the emulated bus: control protocol, registers, data endpoint.

It streams only after the documented sequences were written in order, and records deviations in
``watch.violations``. How a camera reacts to a wrong order, whether a packet of full USB packets
ends with an empty one, and what its bridge buffers after a stop are *unconfirmed on hardware*; the
model takes the case that is harder for the driver.
"""

from __future__ import annotations

import errno
import threading
import time
from collections.abc import Callable

from eschorty_ros.emulation.bus import (
    SPEED_SUPER,
    EmulatedUsbDevice,
    EndpointIdentity,
    UsbFault,
    UsbIdentity,
    Wait,
)
from eschorty_ros.emulation.evk4.registers import SENSOR_RESET, Registers
from eschorty_ros.emulation.evk4.sequences import Phase, SequenceWatch
from eschorty_ros.emulation.evk4.settings import SETTING_ADDRESSES, SensorSettings, read_settings
from eschorty_ros.emulation.evk4.stream import PixelMask, SensorSource, without_triggers
from eschorty_ros.emulation.evk4.treuzell import BoardIdentity, TreuzellBoard

CONTROL_OUT, CONTROL_IN, DATA_IN = 0x02, 0x82, 0x81
PACKET_BYTES = 1024
_PULL_BYTES = 96 << 10


class Evk4Model(EmulatedUsbDevice):
    """EVK4 with an IMX636.

    - ``source``: Returns the pixels' words while the sensor streams; read only when the host reads.
    - ``clock_ns``: With a clock the waits of the register sequences are checked, too.
    - ``wait``: As for ``EmulatedUsbDevice``.

    Public attributes:
    - ``watch``: Phase and violations.
    - ``board``: Answers requests.
    - ``configure``: Called with ``SensorSettings`` after a write that changes them.
    - ``lateness_ns``: Returns ``late_ns`` of the words that the source has returned.
    """

    def __init__(
        self,
        source: SensorSource,
        *,
        board: BoardIdentity | None = None,
        clock_ns: Callable[[], int] | None = None,
        wait: Wait = threading.Condition.wait,
    ):
        board = board or BoardIdentity()
        super().__init__(
            UsbIdentity(
                0x04B4,
                0x00F5,
                interface_class=0xFF,
                interface_subclass=0x19,
                interface_protocol=0,
                endpoints=tuple(
                    EndpointIdentity(address, PACKET_BYTES)
                    for address in (CONTROL_IN, CONTROL_OUT, DATA_IN)
                ),
                serial=f"{board.serial:08x}",
                manufacturer="Prophesee",
                product="EVK4",
                bcd_device=0x0309,
                speed=SPEED_SUPER,
            ),
            wait=wait,
        )
        self.registers = Registers()
        self.watch = SequenceWatch(clock_ns)
        self.configure: Callable[[SensorSettings], None] | None = None
        self.lateness_ns: Callable[[], int] | None = None
        self._source = source
        self.board = TreuzellBoard(board, self)
        self._mask = PixelMask((), (), ())
        # Held by the reading thread and by the one that starts and stops.
        self._stream_lock = threading.Lock()
        self._run = 0
        self._settings = read_settings(self.registers)

    @property
    def settings(self) -> SensorSettings:
        """Return the settings in the registers."""
        return self._settings

    def bulk_out(self, endpoint: int, data: bytes, timeout_ms: int) -> int:
        """Receive a control request and queue its answer."""
        if endpoint != CONTROL_OUT:
            raise UsbFault(errno.EPIPE)
        self.reply(CONTROL_IN, self.board.answer(data))
        return len(data)

    def bulk_in(self, endpoint: int, size: int, timeout_ms: int) -> bytes:
        """Send an answer or the next packet of events."""
        if endpoint == DATA_IN and self.watch.phase is Phase.STREAMING:
            begun_s = time.monotonic()
            self._pull(timeout_ms / 1e3)
            # For libusb 0 ms is unlimited.
            left_ms = timeout_ms - round((time.monotonic() - begun_s) * 1e3)
            timeout_ms = max(left_ms, 1) if timeout_ms else 0
        return super().bulk_in(endpoint, size, timeout_ms)

    def read(self, address: int) -> int:
        """Read a register, as the control protocol does."""
        return self.registers.read(address)

    def write(self, address: int, value: int) -> None:
        """Write a register, as the control protocol does."""
        before = self.registers[address]
        self.registers.write(address, value)
        was = self.watch.phase
        if address == SENSOR_RESET and before and not value:
            self.watch.sensor_reset()
        self.watch.wrote(address, before, value)
        if was is not self.watch.phase:
            self._change(was)
        if address in SETTING_ADDRESSES:
            self._configure()

    def stale(self, data: bytes) -> None:
        """Queue data of an earlier stream in the data endpoint."""
        self._send(data)

    def power_up(self) -> None:
        """Set every register to its reset value."""
        super().power_up()
        was = self.watch.phase
        self.watch.reset()
        self._change(was)
        self.registers.reset()
        self._configure()

    def _change(self, was: Phase) -> None:
        if was is Phase.STREAMING:
            with self._stream_lock:
                self._run += 1
            self._source.stop()
        elif self.watch.phase is Phase.STREAMING:
            self._source.start()

    def _configure(self) -> None:
        settings = read_settings(self.registers)
        if settings != self._settings:
            self._settings = settings
            self._mask = PixelMask(settings.columns_off, settings.rows_off, settings.pixels_off)
            if self.configure:
                self.configure(settings)

    def _pull(self, timeout_s: float) -> None:
        """Move words from the source to the endpoint until some have come or time is up."""
        run, until_s = self._run, time.monotonic() + timeout_s
        while not self.pending(DATA_IN):
            data = self._source.read(_PULL_BYTES, max(0.0, until_s - time.monotonic()))
            if self.lateness_ns is not None:
                self.late_ns = self.lateness_ns()
            if not self._send_words(data, run):
                return

    def _send_words(self, data: bytes, run: int) -> bool:
        """Queue words; False without any or after the end of their stream."""
        with self._stream_lock:
            if run != self._run or not data:
                return False
            if not self._settings.trigger_in:
                data = without_triggers(data)
            if self._mask:
                data = self._mask.apply(data)
            self._send(data)
        return True

    def _send(self, packet: bytes) -> None:
        if packet:
            self.reply(DATA_IN, packet, zero_length=len(packet) % PACKET_BYTES == 0)
