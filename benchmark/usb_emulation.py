"""How fast the emulated bus delivers, in this process and from another: one table.

Usage: python benchmark/usb_emulation.py [--megabytes 512]
"""

import argparse
import array
import multiprocessing
import tempfile
import time
from pathlib import Path

import usb.core
import usb.util

from eschorty_ros.emulation.usb_backend import EmulatedBackend
from eschorty_ros.emulation.usb_device import (
    SPEED_SUPER,
    EmulatedUsbDevice,
    EndpointIdentity,
    UsbIdentity,
)
from eschorty_ros.emulation.usb_remote import backend
from eschorty_ros.emulation.usb_server import UsbServer

DATA_IN = 0x81
IDENTITY = UsbIdentity(
    0x04B4,
    0x00F5,
    interface_class=0xFF,
    interface_subclass=0x19,
    interface_protocol=0,
    endpoints=(EndpointIdentity(DATA_IN, 1024),),
    speed=SPEED_SUPER,
)
SIZES_KIB = (16, 128, 512)


class Spring(EmulatedUsbDevice):
    """Always has as much data as is asked for."""

    _data = bytes(1 << 20)

    def bulk_in(self, endpoint, size, timeout_ms):
        return memoryview(self._data)[:size]


def serve(path, ready, done):
    device = Spring(IDENTITY)
    with UsbServer(path, lambda: [device]):
        ready.set()
        done.wait()


def rate_mb_s(bus, size, total):
    device = usb.core.find(backend=bus)
    buffer = array.array("B", bytes(size))
    device.read(DATA_IN, buffer)
    begun = time.perf_counter()
    for _ in range(total // size):
        device.read(DATA_IN, buffer)
    seconds = time.perf_counter() - begun
    usb.util.dispose_resources(device)
    return total // size * size / seconds / 1e6


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--megabytes", type=int, default=512)
    total = parser.parse_args().megabytes * 1_000_000
    spawn = multiprocessing.get_context("spawn")
    ready, done = spawn.Event(), spawn.Event()
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "usb.sock")
        server = spawn.Process(target=serve, args=(path, ready, done))
        server.start()
        ready.wait()
        device = Spring(IDENTITY)
        here = EmulatedBackend(lambda: [device])
        print("| read size | same process | another process |\n|---|---|---|")
        for kib in SIZES_KIB:
            rates = [rate_mb_s(bus, kib * 1024, total) for bus in (here, backend(path))]
            print(f"| {kib} KiB | {rates[0]:.0f} MB/s | {rates[1]:.0f} MB/s |")
        done.set()
        server.join()


if __name__ == "__main__":
    main()
