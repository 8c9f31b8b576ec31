"""The recording of a live scan, written by a thread of its own."""

from __future__ import annotations

import contextlib
import threading
from array import array
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eschorty_ros.core.base.errors import EschortyError
from eschorty_ros.core.clocks import NS_PER_US
from eschorty_ros.core.evt3 import WRAP_US
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import Calibration
from eschorty_ros.core.reconstruction import Reconstructor
from eschorty_ros.core.storage import Points, ScanLog
from eschorty_ros.core.storage.recording import STAGE_DTYPE
from eschorty_ros.core.storage.recording_writer import RecordingWriter, make_recording_folder
from eschorty_ros.live.job_queue import Job
from eschorty_ros.live.packet_times import GAP_NS, Packet
from eschorty_ros.live.sensor_epoch import SensorEpoch

QUEUE_BYTES = 256 << 20
"""Memory of the packets that wait for the disk: seconds of the camera's highest rate."""
_OTHER_STREAM = "camera, modulation or settings were changed during the scan"


class ScanRecorder:
    """Records the packets that a stream reconstructs, the stage and the laser, into one folder.

    The calls queue and return. A disk that is too slow leaves out packets, a full one those to
    come; they are counted. What has been written is a valid recording at every moment, also when
    the process is killed. `reconstruct_recording` makes the scan's points of it: recording and
    reconstruction begin with the same packet.

    - ``folder``: The recording; made by the thread.
    - ``settings``: Settings of the reconstruction.
    - ``queue_bytes``: Most bytes of packets that wait for the disk.
    - ``waits``: Whether ``packet`` waits for the disk instead of leaving packets out.

    Public attributes:
    - ``failure``: The first thing that could not be written and why, ``""`` for nothing.
    """

    def __init__(
        self,
        folder: Path,
        scan: ScanLog,
        calibration: Calibration,
        settings: Mapping[str, Any],
        queue_bytes: int = QUEUE_BYTES,
        waits: bool = False,
    ) -> None:
        self.folder = folder
        self._log, self._calibration, self._settings = scan, calibration, dict(settings)
        self._queue_bytes, self._waiting_bytes = queue_bytes, 0
        self._waits = waits
        self._jobs: deque[tuple[Job, int]] = deque()
        self._arrived = threading.Condition()
        self._made, self._ended = threading.Event(), threading.Event()
        # Of the reconstruction's thread.
        self._run: tuple[Reconstructor, SensorEpoch, int] | None = None
        self._lost = self._left_out = self._missing = self._last_ns = self._sent = 0
        # Whether packets may hold light: until it is known that it has ended.
        self._lit, self._laser_on = True, False
        self._modulation: Modulation | None = None
        # Why the stream is not that of the recording any more, and why packets were left out.
        self._stream_ended = self._cause = ""
        self._stage_ns, self._stage_mm = array("q"), array("d")
        # Of the recorder's thread.
        self._writer: RecordingWriter | None = None
        self._unwritten = 0
        self.failure = ""
        # A disk that hangs must not keep the process from its end.
        threading.Thread(target=self._work, name="recorder", daemon=True).start()

    def made(self, timeout_s: float) -> str:
        """Wait for the folder; return why there is none, ``""`` when it is there.

        A folder that is made later is removed, and nothing is recorded.
        """
        if not self._made.wait(timeout_s):
            self.end(None)
            return f"cannot record into {self.folder}: the disk does not answer"
        return self.failure

    def wait(self, timeout_s: float) -> str:
        """Wait for the end; return what the recording lacks of the scan, ``""`` for nothing."""
        if not self._ended.wait(timeout_s):
            return f"the recording {self.folder} is still being written"
        faults = "; ".join(self._log.faults) or self.failure
        return faults and f"recording {self.folder}: {faults}"

    # Called by the reconstruction's thread.

    def packet(
        self, packet: Packet, lost: int, run: tuple[Reconstructor, SensorEpoch], wraps: int
    ) -> None:
        """Queue a packet that the reconstructor is about to get, after ``lost`` missing ones.

        ``run`` is the reconstructor and the epoch of its clock; ``wraps`` the wraps of the 24-bit
        time before its first packet.
        """
        if self._run is None:
            self._run, lost = (*run, wraps), 0
            self._modulation = run[0].modulation
            self._queue(self._begin)
        elif run != self._run[:2] or run[0].modulation != self._modulation:
            self._stream_ended = _OTHER_STREAM
        elif self._missing and packet.stamp_ns - self._last_ns > GAP_NS:
            self._stream_ended = "a gap was longer than 8 s"
        self._lost += lost
        self._missing += lost
        if self._waits:
            with self._arrived:
                self._arrived.wait_for(lambda: self._waiting_bytes <= self._queue_bytes)
        if self._stream_ended or self._waiting_bytes > self._queue_bytes:
            self._missing += 1
            if self._lit or not self._stream_ended:
                self._left_out += 1
                self._cause = (
                    self._stream_ended or f"the disk took none for {self._queue_bytes >> 20} MiB"
                )
            return
        missing, laser_on, data = self._missing, self._laser_on, packet.data
        self._missing, self._laser_on, self._last_ns = 0, False, packet.stamp_ns
        self._queue(lambda: self._write_packet(data, missing, laser_on), len(data))
        self._send_stage()

    def laser_on(self) -> None:
        """Note that the phase is estimated again from the next packet on."""
        self._lit = self._laser_on = True

    def laser_off(self) -> None:
        """Note that the scan needs no packet of another stream from the next one on."""
        self._lit = False

    def stage(self, t_ns: int, position_mm: float) -> None:
        """Queue a stage sample at ROS time ``t_ns``."""
        self._stage_ns.append(t_ns // NS_PER_US * NS_PER_US)
        self._stage_mm.append(position_mm)
        self._send_stage()

    def end(self, points: Points | None, reason: str = "") -> None:
        """Queue the end: the stage by the clock as it is known now, the log, the cloud.

        ``reason`` is why the recording is not that of the entire scan.
        """
        samples = self._samples(0)
        self._queue(lambda: self._write_end(samples, points, reason))

    def _send_stage(self) -> None:
        samples = self._samples(self._sent)
        if len(samples):
            self._sent += len(samples)
            self._queue(lambda: self._append_stage(samples))

    def _samples(self, begin: int) -> NDArray[np.void]:
        """Return the stage samples from ``begin`` on in the stream's sensor time."""
        if self._run is None or self._run[1].clock.line is None:
            return np.empty(0, STAGE_DTYPE)
        _, epoch, wraps = self._run
        samples = np.empty(len(self._stage_ns) - begin, STAGE_DTYPE)
        t_ns = np.array(self._stage_ns[begin:], np.int64)
        samples["t_us"] = epoch.clock.to_us(t_ns) - wraps * WRAP_US
        samples["position_mm"] = self._stage_mm[begin:]
        return samples

    def _queue(self, job: Job, size: int = 0) -> None:
        with self._arrived:
            self._jobs.append((job, size))
            self._waiting_bytes += size
            self._arrived.notify_all()

    # The recorder's thread.

    def _work(self) -> None:
        with self._noted():
            make_recording_folder(self.folder)
        if self.failure:
            self._ended.set()
        self._made.set()
        while not self._ended.is_set():
            with self._arrived:
                self._arrived.wait_for(lambda: bool(self._jobs))
                job, size = self._jobs.popleft()
            with self._noted():
                job()
            with self._arrived:
                self._waiting_bytes -= size
                self._arrived.notify_all()
            # Frees the packet before the next job comes.
            del job

    @contextlib.contextmanager
    def _noted(self) -> Iterator[None]:
        """Keep the first failure; what comes later may still be written."""
        try:
            yield
        except EschortyError as error:
            self.failure = self.failure or str(error)
        except Exception as error:
            # A caller that waits for the disk would never return.
            self.failure = self.failure or repr(error)

    def _begin(self) -> None:
        assert self._modulation is not None
        self._writer = RecordingWriter(
            self.folder, self._calibration, self._modulation, self._log, self._settings
        )

    def _write_packet(self, data: Any, missing: int, laser_on: bool) -> None:
        if self.failure or self._writer is None:
            self._unwritten += 1
            return
        try:
            if missing or laser_on:
                self._writer.mark(missing, laser_on)
            self._writer.events(data)
        except EschortyError:
            self._unwritten += 1
            raise

    def _append_stage(self, samples: NDArray[np.void]) -> None:
        if self._writer is not None:
            for t_us, position_mm in samples.tolist():
                self._writer.stage(t_us, position_mm)

    def _write_end(self, samples: NDArray[np.void], points: Points | None, reason: str) -> None:
        writer = self._writer
        left_out = self._left_out + self._unwritten
        self._log = replace(
            self._log,
            state="ended",
            packets_lost=self._lost,
            packets_left_out=left_out,
            reason=self.failure or self._cause or None,
        )
        lacks = "; ".join(text for text in (self._log.reason, reason) if text) or None
        try:
            if writer is None:
                with contextlib.suppress(OSError):
                    self.folder.rmdir()
                self.failure = self.failure or "no packet came"
                return
            with self._noted():
                newest = np.maximum.accumulate(samples["t_us"])
                kept = np.diff(newest, prepend=np.iinfo(np.int64).min >> 1) > 0
                if np.count_nonzero(kept) > 1:
                    writer.replace_stage(samples[kept])
            with self._noted():
                writer.end(replace(self._log, reason=lacks), points)
            writer.close()
        finally:
            self._ended.set()
