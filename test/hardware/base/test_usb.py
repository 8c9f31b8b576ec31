"""Finding and opening USB devices: one device, or an error in one line with its remedy."""

import errno
from dataclasses import replace

import pytest
import usb.backend.libusb1
import usb.core
from usb_loop import IDENTITY, OUT, Loop

from eschorty_ros.core.base.errors import (
    ArgumentError,
    DeviceError,
    DeviceGoneError,
    DeviceStallError,
    DeviceTimeoutError,
)
from eschorty_ros.emulation.bus import EmulatedBackend
from eschorty_ros.hardware.base import usb as usb_access


def is_loop(device):
    return device.idVendor == 0x1234


def find(*models, serial=""):
    backend = EmulatedBackend(lambda: models)
    return usb_access.find_device(backend, name="loop", matches=is_loop, serial=serial)


def line(caught):
    text = str(caught.value)
    assert "\n" not in text
    return text


def test_the_only_device_is_found_fresh_each_time():
    loop = Loop()
    assert find(loop) is not find(loop)


def test_serials_are_compared_without_case_and_others_are_named():
    a, b = Loop(replace(IDENTITY, serial="00aB")), Loop(replace(IDENTITY, serial="00ac"))
    assert find(a, b, serial="00AB").address == a.address
    with pytest.raises(DeviceGoneError) as caught:
        find(a, b, serial="77")
    assert "serial 77" in line(caught)
    assert "00aB, 00ac" in line(caught)


def test_no_device_and_several_are_errors_with_a_remedy():
    with pytest.raises(DeviceGoneError, match="check cable"):
        find()
    with pytest.raises(DeviceError, match=r"2 devices match .* give the serial"):
        find(Loop(), Loop())


@pytest.mark.parametrize("serial", ["", "LOOP1"])
@pytest.mark.fault("no permission, busy")
def test_no_permission(serial):
    """driver: does not open the device; user reads: permission denied, install the udev rules."""
    loop = Loop()
    loop.denied = True
    with pytest.raises(DeviceError, match="permission denied; install the udev rules") as caught:
        find(loop, serial=serial)
    line(caught)


@pytest.mark.fault("no permission, busy")
def test_kernel_driver_holds_the_interface():
    """driver: detaches the kernel driver, gives it back on close; user reads: nothing."""
    loop = Loop()
    loop.kernel_driver = "usbtmc"
    device = find(loop)
    detached = usb_access.claim(device, 0, "loop")
    assert detached
    assert device.write(OUT, b"x") == 1
    usb_access.release(device, 0, reattach=detached)
    assert loop.kernel_driver == "usbtmc"


@pytest.mark.fault("two clients")
def test_second_client_of_a_usb_device():
    """driver: the second fails, the first goes on; user reads: in use, close the other program."""
    loop = Loop()
    first, second = find(loop), find(loop)
    assert not usb_access.claim(first, 0, "loop")
    with pytest.raises(DeviceError, match="in use; close the other program") as caught:
        usb_access.claim(second, 0, "loop")
    line(caught)
    usb_access.release(first, 0, reattach=False)
    usb_access.claim(second, 0, "loop")


def test_release_of_an_unplugged_device_does_not_raise():
    loop = Loop()
    device = find(loop)
    usb_access.claim(device, 0, "loop")
    loop.gone = True
    usb_access.release(device, 0, reattach=True)


@pytest.mark.parametrize(
    ("code", "kind"),
    [
        (errno.ENODEV, DeviceGoneError),
        (errno.ETIMEDOUT, DeviceTimeoutError),
        (errno.EPIPE, DeviceStallError),
        (errno.EIO, DeviceError),
        (errno.EOVERFLOW, DeviceError),
        (None, DeviceError),
    ],
)
def test_errors_are_distinguished_by_number(code, kind):
    error = usb_access.translate(usb.core.USBError("text", None, code), "EVK4: reading")
    assert type(error) is kind
    assert str(error).startswith("EVK4: reading: ")
    assert "\n" not in str(error)


def backend_by_name(argument="none"):
    return argument


def test_a_backend_is_imported_by_name_with_its_argument():
    assert usb_access.open_backend(f"{__name__}:backend_by_name") == "none"
    assert usb_access.open_backend(f"{__name__}:backend_by_name?/a/b") == "/a/b"


@pytest.mark.parametrize("spec", ["", "nowhere", "nowhere:x", f"{__name__}:missing"])
def test_a_backend_that_cannot_be_imported_is_one_line(spec):
    with pytest.raises(ArgumentError, match="use libusb or module:callable") as caught:
        usb_access.open_backend(spec)
    line(caught)


def test_without_any_libusb_the_remedy_is_named(monkeypatch):
    monkeypatch.setattr(usb.backend.libusb1, "get_backend", lambda **_: None)
    monkeypatch.setitem(__import__("sys").modules, "libusb_package", None)
    with pytest.raises(DeviceError, match="install libusb") as caught:
        usb_access.open_backend("libusb")
    line(caught)
