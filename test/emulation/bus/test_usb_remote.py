"""The emulated bus over a socket: threads, clients and servers that end, missing servers."""

import errno
import os
import subprocess
import sys
import threading
import time

import pytest
import usb.core
import usb.util
from short_folder import short_folder
from usb_loop import IN, OUT, Loop
from waiting import DEADLINE_S

from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.emulation.bus import UsbServer, usb_remote
from eschorty_ros.hardware.base.usb import open_backend


@pytest.fixture
def loop():
    return Loop(wait=threading.Condition.wait)


@pytest.fixture
def folder():
    with short_folder() as folder:
        yield folder


@pytest.fixture
def path(loop, folder):
    path = folder / "usb.sock"
    with UsbServer(path, lambda: [loop]):
        yield str(path)


@pytest.fixture
def opened():
    devices = []

    def open_one(path):
        backend = open_backend(f"eschorty_ros.emulation.bus.usb_remote:backend?{path}")
        device = usb.core.find(backend=backend, idVendor=0x1234)
        devices.append(device)
        return device

    yield open_one
    for device in filter(None, devices):
        usb.util.dispose_resources(device)


def test_a_write_goes_through_while_another_thread_waits_in_a_read(path, opened):
    device = opened(path)
    got = []
    usb.util.claim_interface(device, 0)
    reader = threading.Thread(
        target=lambda: got.append(device.read(IN, 64, 0).tobytes()), daemon=True
    )
    reader.start()
    device.write(OUT, b"here")
    reader.join(DEADLINE_S)
    assert got == [b"here"]


def claim_when_free(device):
    """Claim once the server has noticed the end of the other link."""
    for _ in range(6000):
        try:
            return usb.util.claim_interface(device, 0)
        except usb.core.USBError:
            time.sleep(0.01)
    raise AssertionError("the claim was never freed")


CLIENT = """
import sys, threading
import usb.core, usb.util
from eschorty_ros.emulation.bus.usb_remote import backend
device = usb.core.find(backend=backend(sys.argv[1]), idVendor=0x1234)
usb.util.claim_interface(device, 0)
threading.Thread(target=lambda: device.read(0x82, 64, 0)).start()
print("claimed", flush=True)
"""


def test_a_client_that_is_killed_frees_its_claim_and_leaves_no_read_behind(path, opened):
    with subprocess.Popen(
        [sys.executable, "-c", CLIENT, path], stdout=subprocess.PIPE, text=True
    ) as client:
        try:
            assert client.stdout.readline() == "claimed\n"
            device = opened(path)
            with pytest.raises(usb.core.USBError):
                usb.util.claim_interface(device, 0)
        finally:
            client.kill()
        claim_when_free(device)
    device.write(OUT, b"mine")
    assert device.read(IN, 64).tobytes() == b"mine"


def test_after_replug_or_a_dead_server_the_device_is_gone(folder, loop, opened):
    path = str(folder / "usb.sock")
    server = UsbServer(path, lambda: [loop])
    device = opened(path)
    device.write(OUT, b"x")
    loop.replug()
    with pytest.raises(usb.core.USBError) as caught:
        device.write(OUT, b"x")
    assert caught.value.errno == errno.ENODEV
    device = opened(path)
    device.write(OUT, b"x")
    server.close()
    for attempt in (lambda: device.read(IN, 64), lambda: device.clear_halt(IN)):
        with pytest.raises(usb.core.USBError) as caught:
            attempt()
        assert caught.value.errno == errno.ENODEV
    assert opened(path) is None


def test_a_read_that_the_server_leaves_unanswered_loses_the_device(folder, opened, monkeypatch):
    loop = Loop(wait=lambda condition, _: condition.wait(DEADLINE_S))
    path = str(folder / "usb.sock")
    with UsbServer(path, lambda: [loop]):
        device = opened(path)
        device.write(OUT, b"x")
        assert device.read(IN, 64).tobytes() == b"x"
        with monkeypatch.context() as patch:
            patch.setattr(usb_remote, "_ANSWER_TIMEOUT_S", 0.01)
            with pytest.raises(usb.core.USBError) as caught:
                device.read(IN, 64, timeout=1)
        assert caught.value.errno == errno.ENODEV


def test_no_server_is_an_empty_bus(folder, opened):
    assert opened(folder / "none.sock") is None


def test_a_socket_left_behind_by_a_dead_server_is_replaced(folder, loop, opened):
    path = folder / "usb.sock"
    path.write_text("")
    with UsbServer(path, lambda: [loop]):
        assert opened(path) is not None
    assert not os.path.exists(path)


def test_a_path_that_is_no_socket_path_is_one_line(tmp_path, loop):
    long = tmp_path / ("x" * 120)
    with pytest.raises(DeviceError, match="give a short path"):
        UsbServer(long, lambda: [loop])
    with pytest.raises(DeviceError, match="check the path"):
        usb_remote.backend(str(long)).enumerate_devices()
