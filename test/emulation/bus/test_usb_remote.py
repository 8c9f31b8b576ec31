"""The emulated bus over a socket: threads, clients and servers that end, missing servers."""

import errno
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
import usb.core
import usb.util
from short_folder import short_folder
from usb_loop import IN, OUT, Loop
from waiting import DEADLINE_S, wait_until

from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.emulation.bus import UsbServer, usb_remote
from eschorty_ros.hardware.base.usb import open_backend


@pytest.fixture
def loop():
    return Loop(wait=threading.Condition.wait)


@pytest.fixture
def path():
    with short_folder() as folder:
        yield folder / "usb.sock"


@pytest.fixture
def server(loop, path):
    with UsbServer(path, lambda: [loop]) as server:
        yield server


@pytest.fixture
def opened(path):
    devices = []

    def open_one():
        backend = open_backend(f"eschorty_ros.emulation.bus.usb_remote:backend?{path}")
        devices.append(usb.core.find(backend=backend, idVendor=0x1234))
        return devices[-1]

    yield open_one
    for device in filter(None, devices):
        usb.util.dispose_resources(device)


def test_a_write_goes_through_while_another_thread_waits_in_a_read(server, opened):
    device = opened()
    usb.util.claim_interface(device, 0)
    with ThreadPoolExecutor() as pool:
        reading = pool.submit(device.read, IN, 64, 0)
        device.write(OUT, b"here")
        assert reading.result(DEADLINE_S).tobytes() == b"here"


CLIENT = """
import sys, threading
import usb.core, usb.util
from eschorty_ros.emulation.bus.usb_remote import backend
device = usb.core.find(backend=backend(sys.argv[1]), idVendor=0x1234)
usb.util.claim_interface(device, 0)
threading.Thread(target=lambda: device.read(0x82, 64, 0)).start()
print("claimed", flush=True)
"""


def test_a_client_that_is_killed_frees_its_claim_and_leaves_no_read_behind(
    loop, server, path, opened
):
    command = [sys.executable, "-c", CLIENT, path]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as client:
        try:
            assert client.stdout.readline() == "claimed\n"
            device = opened()
            with pytest.raises(usb.core.USBError):
                usb.util.claim_interface(device, 0)
        finally:
            client.kill()
    # The server frees the claim when it notices the end of the link.
    wait_until(lambda: not loop.claims, "the claim freed")
    usb.util.claim_interface(device, 0)
    device.write(OUT, b"mine")
    assert device.read(IN, 64).tobytes() == b"mine"


def test_after_the_end_of_the_server_the_device_is_gone(server, opened):
    device = opened()
    device.write(OUT, b"x")
    server.close()
    for attempt in (lambda: device.read(IN, 64), lambda: device.clear_halt(IN)):
        with pytest.raises(usb.core.USBError) as caught:
            attempt()
        assert caught.value.errno == errno.ENODEV
    assert opened() is None


def test_a_read_that_the_server_leaves_unanswered_loses_the_device(path, opened, monkeypatch):
    loop = Loop(wait=lambda condition, _: condition.wait(DEADLINE_S))
    with UsbServer(path, lambda: [loop]):
        device = opened()
        device.write(OUT, b"x")
        assert device.read(IN, 64).tobytes() == b"x"
        with monkeypatch.context() as patch:
            patch.setattr(usb_remote, "_ANSWER_TIMEOUT_S", 0.01)
            with pytest.raises(usb.core.USBError) as caught:
                device.read(IN, 64, timeout=1)
        assert caught.value.errno == errno.ENODEV


def test_a_socket_left_behind_by_a_dead_server_is_replaced(path, loop, opened):
    assert opened() is None
    path.write_text("")
    with UsbServer(path, lambda: [loop]):
        assert opened() is not None
    assert not path.exists()


def test_a_path_that_is_no_socket_path_is_one_line(tmp_path, loop):
    long = tmp_path / ("x" * 120)
    with pytest.raises(DeviceError, match="give a short path"):
        UsbServer(long, lambda: [loop])
    with pytest.raises(DeviceError, match="check the path"):
        usb_remote.backend(str(long)).enumerate_devices()
