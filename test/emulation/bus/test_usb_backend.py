"""The emulated bus follows pyusb's and libusb's rules, in this process and over a socket."""

import array
import contextlib
import errno
import functools
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
import usb.core
import usb.util
from short_folder import short_folder
from usb_loop import IN, OUT, PACKET, Loop
from waiting import DEADLINE_S, wait_until

from eschorty_ros.emulation.bus import EmulatedBackend, UsbServer
from eschorty_ros.hardware.base.usb import open_backend


@pytest.fixture
def loop():
    return Loop()


@contextlib.contextmanager
def refused(number, code):
    """A transfer that fails with this errno and this code of libusb."""
    with pytest.raises(usb.core.USBError) as caught:
        yield
    assert (caught.value.errno, caught.value.backend_error_code) == (number, code)


@pytest.fixture(params=["in this process", "over a socket"])
def opened(request):
    """A function that opens a model on a bus in this process or on one behind a socket."""
    devices = []
    with contextlib.ExitStack() as stack:

        @functools.cache
        def bus(model):
            if request.param == "in this process":
                return EmulatedBackend(lambda: [model])
            path = stack.enter_context(short_folder()) / "usb.sock"
            stack.enter_context(UsbServer(path, lambda: [model]))
            return open_backend(f"eschorty_ros.emulation.bus.usb_remote:backend?{path}")

        def open_on(model):
            devices.append(usb.core.find(backend=bus(model), idVendor=0x1234))
            return devices[-1]

        yield open_on
        for device in filter(None, devices):
            usb.util.dispose_resources(device)


def test_pyusb_reads_the_descriptors_and_strings(loop, opened):
    device = opened(loop)
    assert (device.idVendor, device.idProduct, device.serial_number) == (0x1234, 0x5678, "LOOP1")
    interface = device.get_active_configuration()[(0, 0)]
    assert (interface.bInterfaceClass, interface.bInterfaceSubClass) == (0xFF, 0x19)
    assert [(e.bEndpointAddress, e.wMaxPacketSize) for e in interface] == [(OUT, 64), (IN, 64)]


def test_what_is_written_comes_back_in_both_ways_of_reading(loop, opened):
    device = opened(loop)
    device.write(OUT, b"abc")
    assert device.read(IN, 512).tobytes() == b"abc"
    device.write(OUT, b"defg")
    buffer = array.array("B", bytes(512))
    assert device.read(IN, buffer) == 4
    assert buffer[:4].tobytes() == b"defg"


def test_a_transfer_longer_than_the_buffer_goes_on_in_the_next_read(loop, opened):
    device = opened(loop)
    data = bytes(range(200))
    device.write(OUT, data)
    first = device.read(IN, 2 * PACKET).tobytes()
    assert first + device.read(IN, 2 * PACKET).tobytes() == data
    assert len(first) == 2 * PACKET


def test_an_exact_multiple_without_an_empty_packet_blocks_a_larger_read_and_is_lost(loop, opened):
    loop.zero_length = False
    device = opened(loop)
    device.write(OUT, bytes(2 * PACKET))
    with refused(errno.ETIMEDOUT, -7):
        device.read(IN, 4 * PACKET)
    device.write(OUT, b"next")
    assert device.read(IN, 4 * PACKET).tobytes() == b"next"


def test_an_exact_multiple_fills_the_buffer_and_leaves_its_empty_packet_for_the_next_read(
    loop, opened
):
    device = opened(loop)
    device.write(OUT, bytes(2 * PACKET))
    assert len(device.read(IN, 2 * PACKET)) == 2 * PACKET
    assert len(device.read(IN, 2 * PACKET)) == 0


def test_a_packet_larger_than_the_rest_of_the_buffer_overflows_and_is_lost(loop, opened):
    device = opened(loop)
    device.write(OUT, bytes(PACKET) + b"tail")
    with refused(errno.EOVERFLOW, -8):
        device.read(IN, 10)
    assert device.read(IN, PACKET).tobytes() == b"tail"


def test_a_stalled_endpoint_refuses_until_its_halt_is_cleared(loop, opened):
    device = opened(loop)
    loop.stalled.add(OUT)
    for _ in range(2):
        with refused(errno.EPIPE, -9):
            device.write(OUT, b"x")
    device.clear_halt(OUT)
    assert device.write(OUT, b"x") == 1


def test_a_mute_device_times_out_in_both_directions(loop, opened):
    device = opened(loop)
    loop.mute = True
    with pytest.raises(usb.core.USBTimeoutError):
        device.write(OUT, b"x")
    with pytest.raises(usb.core.USBTimeoutError):
        device.read(IN, 64)


def test_after_replug_the_old_handle_stays_dead_and_a_new_search_finds_the_device(loop, opened):
    device = opened(loop)
    device.write(OUT, b"x")
    loop.gone = True
    assert opened(loop) is None
    loop.replug()
    with refused(errno.ENODEV, -4):
        device.read(IN, 64)
    fresh = opened(loop)
    assert fresh.address != device.address
    fresh.write(OUT, b"y")
    assert fresh.read(IN, 64).tobytes() == b"y"


@pytest.mark.parametrize("mute", [False, True])
def test_unplugging_wakes_a_waiting_read(mute, opened):
    loop = Loop(wait=threading.Condition.wait)
    device = opened(loop)
    device.write(OUT, b"x")
    device.read(IN, 64)
    loop.mute = mute
    with ThreadPoolExecutor() as pool:
        reading = pool.submit(device.read, IN, 64, timeout=0)
        loop.gone = True
        assert reading.exception(DEADLINE_S).errno == errno.ENODEV


def test_two_handles_cannot_claim_one_interface_until_the_first_closes(loop, opened):
    first, second = opened(loop), opened(loop)
    usb.util.claim_interface(first, 0)
    for attempt in (lambda: usb.util.claim_interface(second, 0), lambda: second.write(OUT, b"x")):
        with refused(errno.EBUSY, -6):
            attempt()
    usb.util.dispose_resources(first)
    # Over a socket, the server frees the claim when it notices the end of the link.
    wait_until(lambda: not loop.claims, "the claim freed")
    usb.util.claim_interface(second, 0)


def test_a_read_about_to_wait_when_its_handle_closes_takes_nothing(loop):
    backend = EmulatedBackend(lambda: [loop])
    handle = backend.open_device(next(backend.enumerate_devices()))
    backend.claim_interface(handle, 0)
    loop.reply(IN, b"for the next one")
    loop.before_transfer = lambda *_: backend.close_device(handle)
    with pytest.raises(usb.core.USBError) as caught:
        backend.bulk_read(handle, IN, 0, array.array("B", bytes(64)), 0)
    assert caught.value.errno == errno.ENODEV
    assert loop.pending(IN)


def test_a_kernel_driver_holds_the_interface_until_detached(loop, opened):
    loop.kernel_driver = "usbtmc"
    device = opened(loop)
    with pytest.raises(usb.core.USBError, match=r"busy"):
        usb.util.claim_interface(device, 0)
    assert device.is_kernel_driver_active(0)
    device.detach_kernel_driver(0)
    usb.util.claim_interface(device, 0)
    usb.util.release_interface(device, 0)
    device.attach_kernel_driver(0)
    assert loop.kernel_driver == "usbtmc"


def test_an_unknown_control_request_stalls(loop, opened):
    with pytest.raises(usb.core.USBError) as caught:
        opened(loop).ctrl_transfer(0xA1, 7, 0, 0, 24)
    assert caught.value.errno == errno.EPIPE
