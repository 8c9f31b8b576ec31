"""Every fault of the camera's USB link: what the driver does, what the user reads."""

# ruff: noqa: E501 - a fault's line of the table in the docs is its docstring

from __future__ import annotations

import errno
import threading
import time
from collections.abc import Callable
from typing import Any

import pytest
from evk4_bench import PATIENCE_S, OnDemand, Rig, until

from eschorty_ros.core.base.errors import DeviceError, DeviceGoneError
from eschorty_ros.emulation.bus.usb_device import UsbFault
from eschorty_ros.emulation.evk4.model import CONTROL_IN, CONTROL_OUT, DATA_IN, Evk4Model
from eschorty_ros.emulation.evk4.sequences import Phase
from eschorty_ros.emulation.evk4.treuzell import BoardIdentity

Answer = Callable[[bytes], bytes]


def spoil(rig: Rig, *changes: Answer) -> None:
    """Let the model's next answers go through ``changes``, one each."""
    pending = list(changes)
    whole = rig.model.board.answer

    def answer(request: bytes) -> bytes:
        reply = whole(request)
        return pending.pop(0)(reply) if pending else reply

    rig.model.board.answer = answer  # type: ignore[method-assign]


def fail_data(rig: Rig, *codes: int) -> None:
    """Let the next reads of the data endpoint fail with these error numbers."""
    pending = list(codes)
    whole = rig.model.bulk_in

    def bulk_in(endpoint: int, size: int, timeout_ms: int) -> bytes:
        if endpoint == DATA_IN and pending and rig.model.watch.phase is Phase.STREAMING:
            raise UsbFault(pending.pop(0))
        return whole(endpoint, size, timeout_ms)

    rig.model.bulk_in = bulk_in  # type: ignore[method-assign]


def read_on(rig: Rig) -> None:
    """Read until the driver gives up."""
    while True:
        rig.camera.read(5.0)


def one_line(error: BaseException | str) -> str:
    text = str(error)
    assert text
    assert "\n" not in text
    return text


@pytest.mark.fault("USB unplugged")
def test_unplug_in_a_scan() -> None:
    """driver: unhealthy at once, waits, finds the same serial, sets up, restarts the stream; user reads: 'the device is gone; check cable and power, then reconnect'."""
    with Rig(attempts=None) as rig:
        rig.streaming()
        rig.camera.set_bias("bias_diff_on", 15)
        rig.exchange()
        rig.model.gone = True
        until(lambda: rig.losses, "the loss")
        assert "the device is gone; check cable and power" in one_line(rig.losses[0])
        assert not rig.camera.healthy
        rig.model.replug()
        until(lambda: rig.count("reconnects") == 1, "the reconnection")
        assert rig.camera.loss == ""
        rig.chunks.clear()
        rig.exchange(9)
        assert rig.chunks[0].restarted
        assert dict(rig.model.settings.biases)["bias_diff_on"] == 15
        assert (rig.count("losses"), rig.count("restarts")) == (1, 2)


@pytest.mark.fault("USB unplugged")
def test_unplug_and_never_back() -> None:
    """driver: bounded attempts with growing waits, then an error; user reads: 'lost, and not back after 4 attempts (...); check cable and power, then configure it again'."""
    with Rig(attempts=4) as rig:
        rig.streaming()
        rig.slept.clear()
        rig.model.gone = True
        with pytest.raises(DeviceGoneError, match="00051234: lost, and not back after 4 attempts"):
            read_on(rig)
        assert rig.slept == [0.5, 1.0, 2.0, 4.0]
        assert rig.count("reconnect_attempts") == 4
        assert not rig.camera.healthy


@pytest.mark.fault("USB unplugged")
def test_another_camera_is_plugged_in_instead() -> None:
    """driver: leaves the other serial alone and keeps looking; user reads: 'none with serial 00051234 can be opened, but there is 00000099; check cable, power and serial'."""
    with Rig(attempts=2) as rig:
        rig.streaming()
        stranger = Evk4Model(OnDemand(), board=BoardIdentity(serial=0x99), wait=lambda *_: False)
        rig.bus[:] = [stranger]
        rig.model.gone = True
        with pytest.raises(DeviceGoneError, match=r"none with serial 00051234.*there is 00000099"):
            read_on(rig)
        assert stranger.watch.phase is Phase.OFF
        assert not stranger.claims


@pytest.mark.fault("USB unplugged")
def test_power_dip_leaves_a_camera_that_does_not_stream() -> None:
    """driver: asks a silent camera, finds it reset, initialises it again; user reads: 'it has stopped streaming by itself (reset or power dip); check its power'."""
    with Rig() as rig:
        rig.streaming()
        rig.exchange()
        rig.model.power_up()
        until(lambda: rig.count("reconnects") == 1, "the reconnection")
        assert "stopped streaming by itself" in one_line(rig.losses[0])
        rig.chunks.clear()
        rig.exchange()
        assert rig.chunks[0].restarted


@pytest.mark.fault("endpoint stalls")
def test_stalled_data_endpoint() -> None:
    """driver: clears the halt once, reports a gap, goes on; user reads: failed_transfers and gaps in the diagnostics."""
    with Rig() as rig:
        rig.streaming()
        rig.exchange()
        rig.model.stalled.add(DATA_IN)
        until(lambda: rig.count("failed_transfers") == 1, "the stall")
        rig.chunks.clear()
        rig.exchange()
        assert rig.chunks[0].gap
        assert (rig.count("gaps"), rig.count("losses")) == (1, 0)


@pytest.mark.fault("endpoint stalls")
def test_data_endpoint_stalls_again() -> None:
    """driver: a second stall in a row is a loss, it reconnects; user reads: 'the device stalled the transfer'."""
    with Rig() as rig:
        rig.streaming()
        fail_data(rig, errno.EPIPE, errno.EPIPE)
        until(lambda: rig.count("reconnects") == 1, "the reconnection")
        assert "stalled the transfer" in one_line(rig.losses[0])
        rig.exchange()
        assert rig.chunks[0].restarted


@pytest.mark.parametrize("endpoint", [CONTROL_IN, CONTROL_OUT])
@pytest.mark.fault("endpoint stalls")
def test_stalled_control_endpoint(endpoint: int) -> None:
    """driver: clears both control endpoints and asks once more; user reads: control_recoveries in the diagnostics."""
    with Rig() as rig:
        rig.streaming()
        rig.model.stalled.add(endpoint)
        assert rig.camera.set_bias("bias_fo", 7) == 7
        assert rig.count("control_recoveries") == 1
        rig.exchange()
        assert rig.count("losses") == 0


@pytest.mark.fault("no answer, time-out")
def test_camera_goes_mute() -> None:
    """driver: asks after 0.1 s of silence, unhealthy when no answer came for 0.5 s, reconnects when it answers again; user reads: 'no answer in time; check that the device is on'."""
    with Rig(attempts=None) as rig:
        rig.streaming()
        rig.exchange()
        rig.model.mute = True
        until(lambda: rig.losses, "the loss")
        assert "no answer in time" in one_line(rig.losses[0])
        assert not rig.camera.healthy
        with pytest.raises(DeviceError, match="bias_fo: the camera is not open"):
            rig.camera.set_bias("bias_fo", 3)
        rig.model.mute = False
        until(lambda: rig.count("reconnects") == 1, "the reconnection")
        rig.exchange()
        until(lambda: rig.camera.healthy, "health")


SPOILT: dict[str, Answer] = {
    "empty answer": lambda _reply: b"",
    "short header": lambda reply: reply[:6],
    "size beyond the bytes": lambda reply: reply[:4] + b"\x40\0\0\0" + reply[8:],
    "bytes beyond the size": lambda reply: reply + b"\0\0\0\0",
    "another property": lambda reply: b"\x79\0\0\0" + reply[4:],
    "flipped bits": lambda reply: bytes([reply[0] ^ 0x10]) + reply[1:],
    "more than asked for": lambda reply: reply + bytes(4096),
}


@pytest.mark.parametrize("name", SPOILT)
@pytest.mark.fault("malformed transfer")
def test_garbled_answer(name: str) -> None:
    """driver: takes no answer it does not recognise, clears the link, asks once more; user reads: control_recoveries in the diagnostics."""
    with Rig() as rig:
        rig.streaming()
        spoil(rig, SPOILT[name])
        assert rig.camera.read_biases()["bias_diff_on"] == 0
        assert rig.count("control_recoveries") == 1
        rig.exchange()


@pytest.mark.parametrize("name", SPOILT)
@pytest.mark.fault("malformed transfer")
def test_garbled_answers_while_opening(name: str) -> None:
    """driver: the second wrong answer ends the attempt and releases the camera; user reads: one line that names the answer."""
    with Rig() as rig:
        spoil(rig, *[SPOILT[name]] * 2)
        with pytest.raises(DeviceError) as caught:
            rig.camera.open()
        one_line(caught.value)
        assert not rig.model.claims
        rig.camera.open()


@pytest.mark.fault("malformed transfer")
def test_overflow_on_the_data_endpoint() -> None:
    """driver: the transfer is lost: a gap is reported, the stream goes on; user reads: failed_transfers and gaps in the diagnostics."""
    with Rig() as rig:
        rig.streaming()
        rig.exchange()
        fail_data(rig, errno.EOVERFLOW)
        until(lambda: rig.count("failed_transfers") == 1, "the overflow")
        rig.chunks.clear()
        rig.exchange()
        assert rig.chunks[0].gap
        assert rig.count("losses") == 0


@pytest.mark.fault("malformed transfer")
def test_transfers_of_zero_length_and_of_whole_packets() -> None:
    """driver: an empty packet ends a transfer, not the stream; user reads: nothing."""
    with Rig() as rig:
        rig.streaming()
        given = rig.source.give(128)
        assert len(given) == 1024
        rig.model.reply(DATA_IN, b"")
        assert rig.read(len(given)) == given
        rig.exchange()
        assert (rig.count("gaps"), rig.count("failed_transfers")) == (0, 0)


@pytest.mark.fault("partial reply")
def test_partial_answer() -> None:
    """driver: an answer in two pieces is thrown away and asked for again; user reads: control_recoveries in the diagnostics."""
    with Rig() as rig:
        rig.camera.open()

        def halved(reply: bytes) -> bytes:
            rig.model.reply(CONTROL_IN, reply[:12])
            return reply[12:]

        spoil(rig, halved)
        assert rig.camera.read_biases()["bias_diff_on"] == 0
        assert rig.count("control_recoveries") == 1


@pytest.mark.fault("stale reply")
def test_stale_answer_after_a_time_out() -> None:
    """driver: an answer that came too late is flushed, never taken for another register; user reads: control_recoveries in the diagnostics."""
    with Rig() as rig:
        rig.camera.open()
        rig.camera.set_bias("bias_fo", 9)
        late = rig.model.board.answer(
            b"\x02\x01\x01\0" + b"\x0c\0\0\0" + bytes(4) + b"\x14\0\0\0\x01\0\0\0"
        )
        rig.model.reply(CONTROL_IN, late)
        biases = rig.camera.read_biases()
        assert biases == {
            "bias_diff_on": 0,
            "bias_diff_off": 0,
            "bias_fo": 9,
            "bias_hpf": 0,
            "bias_refr": 0,
        }
        assert rig.count("control_recoveries") == 1


@pytest.mark.fault("no permission, busy")
def test_access_denied() -> None:
    """driver: one line, nothing claimed, tried again when asked; user reads: 'permission denied; install the udev rules of docs/hardware.md and plug in again'."""
    with Rig() as rig:
        rig.model.denied = True
        with pytest.raises(
            DeviceError, match="permission denied; install the udev rules"
        ) as caught:
            rig.camera.open()
        one_line(caught.value)
        rig.model.denied = False
        rig.camera.open()


@pytest.mark.fault("no permission, busy")
def test_a_kernel_driver_holds_it() -> None:
    """driver: detaches the kernel driver and gives it back on close; user reads: nothing."""
    with Rig() as rig:
        rig.model.kernel_driver = "uvcvideo"
        rig.camera.open()
        assert rig.model.kernel_driver is None
        rig.camera.close()
        assert rig.model.kernel_driver == "uvcvideo"


@pytest.mark.fault("host stalls")
def test_host_stalls() -> None:
    """driver: receives on in its own thread: stamps are those of the receipt, nothing is lost; user reads: queue_bytes in the diagnostics."""
    with Rig() as rig:
        rig.streaming()
        given, received_ns = b"", []
        for round_ in range(1, 6):
            given += rig.source.give(10)
            until(lambda bytes_=80 * round_: rig.count("queue_bytes") == bytes_, "the receipt")
            received_ns.append(time.monotonic_ns())
        time.sleep(0.3)
        assert rig.count("queue_bytes") == len(given)
        assert rig.read(len(given)) == given
        last_ns, done = {}, 0
        for chunk in rig.chunks:
            done += len(chunk.data)
            last_ns[-(-done // 80) - 1] = chunk.arrival_ns
        assert all(last_ns[i] <= received_ns[i] for i in range(5))
        assert rig.count("drops") == 0


@pytest.mark.fault("two clients")
def test_two_clients() -> None:
    """driver: the second program fails in one line, the first streams on; user reads: 'in use; close the other program, or unload the kernel driver that holds it'."""
    with Rig() as rig:
        rig.streaming()
        second = rig.driver()
        with pytest.raises(DeviceError, match="in use; close the other program") as caught:
            second.open()
        one_line(caught.value)
        second.close()
        rig.exchange()
        assert rig.count("losses") == 0


def in_the_background(action: Callable[[], Any]) -> tuple[threading.Thread, list[BaseException]]:
    errors: list[BaseException] = []

    def guarded() -> None:
        try:
            action()
        except DeviceError as error:
            errors.append(error)

    thread = threading.Thread(target=guarded)
    thread.start()
    return thread, errors


@pytest.mark.fault("shutdown at any time")
def test_shutdown_in_the_initialisation() -> None:
    """driver: closing cuts the 2.5 s of the initialisation short and releases the camera; user reads: 'closed before it was ready'."""
    with Rig() as rig:
        camera = rig.driver(sleep=None)
        thread, errors = in_the_background(camera.open)
        until(lambda: rig.model.claims, "the claim")
        camera.close()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()
        assert ["closed before it was ready" in one_line(error) for error in errors] == [True]
        assert not rig.model.claims


@pytest.mark.fault("shutdown at any time")
def test_shutdown_while_reconnecting() -> None:
    """driver: closing ends the search at once; user reads: nothing more."""
    before = set(threading.enumerate())
    with Rig() as rig:
        camera = rig.driver(attempts=None, sleep=None)
        camera.open()
        camera.start()
        rig.model.gone = True
        until(lambda: camera.loss, "the loss")
        camera.close()
        camera.close()
        until(lambda: set(threading.enumerate()) <= before, "the end of its threads")


@pytest.mark.fault("shutdown at any time")
def test_shutdown_in_a_scan_of_a_mute_camera() -> None:
    """driver: closes within 2 s though nothing answers any more; user reads: nothing more."""
    with Rig(attempts=0) as rig:
        rig.streaming()
        rig.exchange()
        waits: list[float] = []

        def wait(condition: threading.Condition, seconds: float | None) -> bool:
            assert seconds is not None
            if threading.current_thread() is threading.main_thread():
                waits.append(seconds)
            return condition.wait(seconds)

        rig.model._wait = wait
        rig.model.mute = True
        rig.camera.close()
        print(f"waited {sum(waits):.2f} s for answers")
        assert sum(waits) < 1.0
        assert not rig.model.claims
