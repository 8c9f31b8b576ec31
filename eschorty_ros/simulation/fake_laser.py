"""A waveform generator that exists in memory only."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

from eschorty_ros.core.errors import DeviceError
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.hardware.protocols import DeviceIdentity, LaserOutput, LaserReadback


class FakeLaser:
    """Emulated laser modulator: off at construction, to be armed before each enable.

    The rising edges lie at ``phase_epoch_ns`` plus whole periods; the epoch is the time of the
    last ``configure``. Thread-safe.

    Parameters
    ----------
    clock_ns : callable
        The clock of all times in ``readback``.
    log_path : path, optional
        Gets a line ``<ns> ON`` or ``<ns> OFF`` at construction and whenever the output changes,
        on disk before the call returns: the emulator's own witness.

    Raises
    ------
    DeviceError
        When the log cannot be written.
    """

    def __init__(self, clock_ns: Callable[[], int], log_path: str | Path | None = None) -> None:
        self.identity = DeviceIdentity("simulated waveform generator", "SIM-LASER")
        self._clock_ns = clock_ns
        self._log_path = None if log_path is None else Path(log_path)
        self._lock = threading.Lock()
        self._modulation = Modulation(70.0)
        self._armed = False
        self._closed = False
        self._output = LaserOutput.OFF
        self._epoch_ns = self._since_ns = clock_ns()
        self._log()

    def configure(self, modulation: Modulation) -> None:
        """Set the waveform; a running output goes on with it from now.

        Raises
        ------
        DeviceError
            When closed.
        """
        with self._lock:
            self._refuse_closed()
            self._modulation = modulation
            self._epoch_ns = self._clock_ns()
            if self._output is LaserOutput.ON:
                self._since_ns = self._epoch_ns

    def arm(self) -> None:
        """Allow the next ``enable``; raises ``DeviceError`` when closed."""
        with self._lock:
            self._refuse_closed()
            self._armed = True

    def enable(self) -> None:
        """Switch the output on; raises ``DeviceError`` when closed or not armed."""
        with self._lock:
            self._refuse_closed()
            if not self._armed:
                raise DeviceError("the laser is not armed; arm it before enabling the output")
            self._armed = False
            self._switch(LaserOutput.ON)

    def disable(self) -> None:
        """Switch the output off and disarm; idempotent."""
        with self._lock:
            self._armed = False
            self._switch(LaserOutput.OFF)

    def readback(self) -> LaserReadback:
        """Tell settings and output; ``on_edge_us`` is unknown, a generator has no sensor clock."""
        with self._lock:
            return LaserReadback(self._output, self._modulation, self._epoch_ns, self._since_ns)

    def close(self) -> None:
        """Switch off and release; idempotent."""
        self.disable()
        with self._lock:
            self._closed = True

    def _refuse_closed(self) -> None:
        if self._closed:
            raise DeviceError("the laser is closed; open it again")

    def _switch(self, output: LaserOutput) -> None:
        if output is not self._output:
            self._output = output
            self._since_ns = self._clock_ns()
            self._log()

    def _log(self) -> None:
        if self._log_path is None:
            return
        try:
            with self._log_path.open("a", encoding="ascii") as stream:
                stream.write(f"{self._since_ns} {self._output.name}\n")
        except OSError as error:
            raise DeviceError(
                f"cannot write the laser log {str(self._log_path)!r} ({error.strerror}); "
                "choose a writable path"
            ) from error
