"""Throughput of the emulated bus in this process and from another, as a table.

The last row is events of the EVK4 model.

Usage: python benchmark/usb_emulation.py [--megabytes 512]
"""

import argparse
import array
import multiprocessing
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import usb.core
import usb.util

from eschorty_ros.emulation.bus import EmulatedBackend, UsbServer
from eschorty_ros.emulation.bus.usb_remote import backend
from eschorty_ros.emulation.evk4 import DATA_IN, SEQUENCES, Evk4Model

EVENTS_PER_US = 20
WARM_UP_READS = 20


class Spring:
    """An endless stream of sparse events, 4 bytes each and two more a microsecond."""

    def __init__(self):
        low = 0x6000 | np.arange(4096, dtype=np.uint16)[:, None]
        y = np.broadcast_to(np.arange(EVENTS_PER_US, dtype=np.uint16), (4096, EVENTS_PER_US))
        pairs = np.stack((y, 0x2000 | y), axis=2).reshape(4096, -1)
        self._piece = np.concatenate((low, pairs), axis=1).ravel()
        self._high = 0

    def start(self):
        self._high = 0

    def stop(self):
        pass

    def read(self, max_bytes, timeout_s):
        self._high += 1
        high = np.array([0x8000 | self._high & 0xFFF], np.uint16)
        return np.concatenate((high, self._piece)).tobytes()


class Firehose(Evk4Model):
    """A camera that always fills the read."""

    _data = memoryview(b"\x2a" * (1 << 20))

    def bulk_in(self, endpoint, size, timeout_ms):
        return self._data[:size]


def streaming_camera():
    camera = Evk4Model(Spring())
    for name in ("init", "start"):
        for step in SEQUENCES[name]:
            camera.write(step.address, camera.read(step.address) & ~step.mask | step.value)
    return camera


@dataclass(frozen=True)
class Row:
    text: str
    size: int
    make: object
    arguments: tuple = ()


ROWS = (
    *(
        Row(f"any bytes, reads of {kib} KiB", kib << 10, Firehose, (None,))
        for kib in (16, 128, 512)
    ),
    Row("events", 128 << 10, streaming_camera),
)


def serve(path, row, ready, done):
    device = row.make(*row.arguments)
    with UsbServer(path, lambda: [device]):
        ready.set()
        done.wait()


def rate_mb_s(bus, size, total):
    device = usb.core.find(backend=bus)
    buffer = array.array("B", bytes(size))
    for _ in range(WARM_UP_READS):
        device.read(DATA_IN, buffer)
    begun, received = time.perf_counter(), 0
    while received < total:
        received += device.read(DATA_IN, buffer)
    seconds = time.perf_counter() - begun
    usb.util.dispose_resources(device)
    return received / seconds / 1e6


def measure(row, path, total):
    device = row.make(*row.arguments)
    here = rate_mb_s(EmulatedBackend(lambda: [device]), row.size, total)
    spawn = multiprocessing.get_context("spawn")
    ready, done = spawn.Event(), spawn.Event()
    server = spawn.Process(target=serve, args=(path, row, ready, done))
    server.start()
    ready.wait()
    there = rate_mb_s(backend(path), row.size, total)
    done.set()
    server.join()
    return here, there


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--megabytes", type=int, default=512)
    total = parser.parse_args().megabytes * 1_000_000
    print("| what | same process | another process |\n|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for row in ROWS:
            here, there = measure(row, str(Path(folder) / "usb.sock"), total)
            print(f"| {row.text} | {here:.0f} MB/s | {there:.0f} MB/s |", flush=True)


if __name__ == "__main__":
    main()
