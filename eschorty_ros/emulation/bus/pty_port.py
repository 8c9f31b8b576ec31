"""A serial device model behind a pseudo-terminal: a port that pyserial opens by its path."""

from __future__ import annotations

import contextlib
import errno
import os
import pty
import select
import termios
import threading
import tty
from pathlib import Path
from typing import Protocol

from eschorty_ros.core.base.errors import DeviceError

_TICK_S = 0.002
# A device at rest does nothing by itself.
_REST_TICK_S = 0.05
_READ_BYTES = 4096


class SerialModel(Protocol):
    """A device on a serial line, with a clock of its own."""

    gone: bool

    @property
    def resting(self) -> bool:
        """Return whether nothing is under way, on the line or in the device."""

    def feed(self, data: bytes) -> None:
        """Receive bytes from the host."""

    def step(self) -> bytes:
        """Advance to the present; return the bytes for the host."""


class PtyPort:
    """Serves a model on a pseudo-terminal, with a fixed link to its varying name.

    While the model is ``gone`` there is no port, and an open one hangs up, as with an unplugged
    USB adapter.

    - ``link``: Path of the port; an old link is replaced.
    - ``lock``: Held while the model acts.

    Raises ``DeviceError`` when the link cannot be made.
    """

    def __init__(
        self,
        model: SerialModel,
        link: str | os.PathLike[str],
        lock: contextlib.AbstractContextManager[bool] | None = None,
    ) -> None:
        self._model = model
        self._link = Path(link)
        self._lock = lock or threading.RLock()
        self._ending = threading.Event()
        self._ends = self._plug_in()
        self._thread = threading.Thread(target=self._serve, name="pty port", daemon=True)
        self._thread.start()

    def __enter__(self) -> PtyPort:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Remove the port; idempotent."""
        self._ending.set()
        self._thread.join()

    def _plug_in(self) -> tuple[int, int]:
        host, device = pty.openpty()
        # Otherwise the line discipline removes carriage returns and 0x11, an APT address.
        tty.setraw(device, termios.TCSANOW)
        os.set_blocking(host, False)
        try:
            self._link.unlink(missing_ok=True)
            self._link.symlink_to(os.ttyname(device))
        except OSError as error:
            os.close(host)
            os.close(device)
            raise DeviceError(
                f"serial port {self._link}: {error.strerror or error}; choose another folder"
            ) from error
        return host, device

    def _unplug(self) -> None:
        ends, self._ends = self._ends, (-1, -1)
        if ends[0] < 0:
            return
        self._link.unlink(missing_ok=True)
        for end in ends:
            os.close(end)

    def _serve(self) -> None:
        try:
            while not self._ending.is_set():
                if self._model.gone:
                    self._unplug()
                    self._ending.wait(_TICK_S)
                    # The model's time passes, and it may be plugged in again.
                    with self._lock:
                        self._model.step()
                    continue
                if self._ends[0] < 0:
                    self._ends = self._plug_in()
                self._exchange(self._ends[0])
        finally:
            self._unplug()

    def _exchange(self, host: int) -> None:
        """Exchange bytes for one tick; the device end stays open, which prevents a hang-up."""
        data = b""
        with self._lock:
            tick_s = _REST_TICK_S if self._model.resting else _TICK_S
        if select.select([host], [], [], tick_s)[0]:
            data = os.read(host, _READ_BYTES)
        with self._lock:
            if data:
                self._model.feed(data)
            out = self._model.step()
        while out:
            try:
                out = out[os.write(host, out) :]
            except OSError as error:
                if error.errno != errno.EAGAIN:
                    raise
                # A serial line without flow control loses what the host does not read.
                return
