"""Faults of the camera's USB link: what the driver does, what the user reads."""

# ruff: noqa: E501 - a fault's line of the table in the docs is its docstring

import errno
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from evk4_bench import CameraBench, OnDemand
from waiting import DEADLINE_S, wait_until

from eschorty_ros.core.base.errors import DeviceError, DeviceGoneError
from eschorty_ros.emulation.bus import UsbFault
from eschorty_ros.emulation.evk4 import (
    CONTROL_IN,
    CONTROL_OUT,
    DATA_IN,
    BoardIdentity,
    Evk4Model,
    Phase,
)
from eschorty_ros.hardware.camera import BIASES

Answer = Callable[[bytes], bytes]


def spoil(bench: CameraBench, *changes: Answer) -> None:
    """Change the model's next answers by ``changes``, one each."""
    pending, unchanged = list(changes), bench.model.board.answer

    def answer(request: bytes) -> bytes:
        reply = unchanged(request)
        return pending.pop(0)(reply) if pending else reply

    bench.model.board.answer = answer  # type: ignore[method-assign]


def fail_data(bench: CameraBench, *codes: int) -> None:
    """Make the next reads of the data endpoint fail with these error numbers."""
    pending, unchanged = list(codes), bench.model.bulk_in

    def bulk_in(endpoint: int, size: int, timeout_ms: int) -> bytes:
        if endpoint == DATA_IN and pending and bench.model.watch.phase is Phase.STREAMING:
            raise UsbFault(pending.pop(0))
        return unchanged(endpoint, size, timeout_ms)

    bench.model.bulk_in = bulk_in  # type: ignore[method-assign]


def read_on(bench: CameraBench) -> None:
    """Read until the driver gives up."""
    while True:
        bench.camera.read(5.0)


def one_line(error: BaseException | str) -> str:
    text = str(error)
    assert text
    assert "\n" not in text
    return text


@pytest.mark.fault("USB unplugged")
def test_unplugged_while_streaming() -> None:
    """driver: unhealthy at once, waits, finds the same serial, initialises it, restarts the stream; user reads: 'the device is gone; check cable and power, then reconnect'."""
    with CameraBench(attempts=None) as bench:
        bench.streaming()
        bench.camera.set_bias("bias_diff_on", 15)
        bench.exchange()
        bench.model.gone = True
        wait_until(lambda: bench.losses, "the loss")
        assert "the device is gone; check cable and power" in one_line(bench.losses[0])
        assert not bench.camera.healthy
        bench.model.replug()
        wait_until(lambda: bench.count("reconnects") == 1, "the reconnection")
        assert bench.camera.loss == ""
        bench.chunks.clear()
        bench.exchange(9)
        assert bench.chunks[0].restarted
        assert dict(bench.model.settings.biases)["bias_diff_on"] == 15
        assert (bench.count("losses"), bench.count("restarts")) == (1, 2)


@pytest.mark.fault("USB unplugged")
def test_unplugged_for_good() -> None:
    """driver: bounded attempts with growing waits, then an error; user reads: 'lost, and not back after 4 attempts (...); check cable and power, then configure it again'."""
    with CameraBench(attempts=4) as bench:
        bench.streaming()
        bench.slept.clear()
        bench.model.gone = True
        with pytest.raises(DeviceGoneError, match="00051234: lost, and not back after 4 attempts"):
            read_on(bench)
        assert bench.slept == [0.5, 1.0, 2.0, 4.0]
        assert bench.count("reconnect_attempts") == 4
        assert not bench.camera.healthy


@pytest.mark.fault("USB unplugged")
def test_another_camera_is_plugged_in_instead() -> None:
    """driver: leaves the other serial alone and searches on; user reads: 'none with serial 00051234 can be opened, but there is 00000099; check cable, power and serial'."""
    with CameraBench(attempts=2) as bench:
        bench.streaming()
        other = Evk4Model(OnDemand(), board=BoardIdentity(serial=0x99), wait=lambda *_: False)
        bench.bus[:] = [other]
        bench.model.gone = True
        with pytest.raises(DeviceGoneError, match=r"none with serial 00051234.*there is 00000099"):
            read_on(bench)
        assert other.watch.phase is Phase.OFF
        assert not other.claims


@pytest.mark.fault("USB unplugged")
def test_power_dip_leaves_a_camera_that_does_not_stream(bench: CameraBench) -> None:
    """driver: asks a camera without events, finds it reset, initialises it again; user reads: 'it has stopped streaming by itself (reset or power dip); check its power'."""
    bench.exchange()
    bench.model.power_up()
    wait_until(lambda: bench.count("reconnects") == 1, "the reconnection")
    assert "stopped streaming by itself" in one_line(bench.losses[0])
    bench.chunks.clear()
    bench.exchange()
    assert bench.chunks[0].restarted


@pytest.mark.fault("endpoint stalls")
def test_stalled_data_endpoint(bench: CameraBench) -> None:
    """driver: clears the halt once, reports a gap, goes on; user reads: failed_transfers and gaps in the diagnostics."""
    bench.exchange()
    bench.model.stalled.add(DATA_IN)
    wait_until(lambda: bench.count("failed_transfers") == 1, "the stall")
    bench.chunks.clear()
    bench.exchange()
    assert bench.chunks[0].gap
    assert (bench.count("gaps"), bench.count("losses")) == (1, 0)


@pytest.mark.fault("endpoint stalls")
def test_data_endpoint_stalls_again(bench: CameraBench) -> None:
    """driver: a second stall in a row is a loss, it reconnects; user reads: 'the device stalled the transfer'."""
    fail_data(bench, errno.EPIPE, errno.EPIPE)
    wait_until(lambda: bench.count("reconnects") == 1, "the reconnection")
    assert "stalled the transfer" in one_line(bench.losses[0])
    bench.exchange()
    assert bench.chunks[0].restarted


@pytest.mark.parametrize("endpoint", [CONTROL_IN, CONTROL_OUT])
@pytest.mark.fault("endpoint stalls")
def test_stalled_control_endpoint(bench: CameraBench, endpoint: int) -> None:
    """driver: clears both control endpoints and sends the request once more; user reads: control_recoveries in the diagnostics."""
    bench.model.stalled.add(endpoint)
    assert bench.camera.set_bias("bias_fo", 7) == 7
    assert bench.count("control_recoveries") == 1
    bench.exchange()
    assert bench.count("losses") == 0


@pytest.mark.fault("no answer, time-out")
def test_camera_stops_answering() -> None:
    """driver: asks after 0.1 s without events, unhealthy after 0.5 s without an answer, reconnects when it answers again; user reads: 'no answer in time; check that the device is on'."""
    with CameraBench(attempts=None) as bench:
        bench.streaming()
        bench.exchange()
        bench.model.mute = True
        wait_until(lambda: bench.losses, "the loss")
        assert "no answer in time" in one_line(bench.losses[0])
        assert not bench.camera.healthy
        with pytest.raises(DeviceError, match="bias_fo: the camera is not open"):
            bench.camera.set_bias("bias_fo", 3)
        bench.model.mute = False
        wait_until(lambda: bench.count("reconnects") == 1, "the reconnection")
        bench.exchange()
        wait_until(lambda: bench.camera.healthy, "health")


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
def test_garbled_answer(bench: CameraBench, name: str) -> None:
    """driver: discards the answer, clears the link, sends the request once more; user reads: control_recoveries in the diagnostics."""
    spoil(bench, SPOILT[name])
    assert bench.camera.read_biases()["bias_diff_on"] == 0
    assert bench.count("control_recoveries") == 1
    bench.exchange()


@pytest.mark.parametrize("name", SPOILT)
@pytest.mark.fault("malformed transfer")
def test_garbled_answers_while_opening(name: str) -> None:
    """driver: the second wrong answer ends the attempt and releases the camera; user reads: one line that names the answer."""
    with CameraBench() as bench:
        spoil(bench, *[SPOILT[name]] * 2)
        with pytest.raises(DeviceError) as caught:
            bench.camera.open()
        one_line(caught.value)
        assert not bench.model.claims
        bench.camera.open()


@pytest.mark.fault("malformed transfer")
def test_overflow_on_the_data_endpoint(bench: CameraBench) -> None:
    """driver: reports the lost transfer as a gap and goes on; user reads: failed_transfers and gaps in the diagnostics."""
    bench.exchange()
    fail_data(bench, errno.EOVERFLOW)
    wait_until(lambda: bench.count("failed_transfers") == 1, "the overflow")
    bench.chunks.clear()
    bench.exchange()
    assert bench.chunks[0].gap
    assert bench.count("losses") == 0


@pytest.mark.fault("malformed transfer")
def test_transfers_of_zero_length_and_of_whole_packets(bench: CameraBench) -> None:
    """driver: an empty packet ends a transfer, not the stream; user reads: nothing."""
    given = bench.source.give(128)
    assert len(given) == 1024
    bench.model.reply(DATA_IN, b"")
    assert bench.read(len(given)) == given
    bench.exchange()
    assert (bench.count("gaps"), bench.count("failed_transfers")) == (0, 0)


@pytest.mark.fault("partial reply")
def test_partial_answer() -> None:
    """driver: discards an answer in two pieces and sends the request again; user reads: control_recoveries in the diagnostics."""
    with CameraBench() as bench:
        bench.camera.open()

        def halved(reply: bytes) -> bytes:
            bench.model.reply(CONTROL_IN, reply[:12])
            return reply[12:]

        spoil(bench, halved)
        assert bench.camera.read_biases()["bias_diff_on"] == 0
        assert bench.count("control_recoveries") == 1


@pytest.mark.fault("stale reply")
def test_stale_answer_after_a_time_out() -> None:
    """driver: discards a late answer, which is recognised by its register; user reads: control_recoveries in the diagnostics."""
    with CameraBench() as bench:
        bench.camera.open()
        bench.camera.set_bias("bias_fo", 9)
        late = bench.model.board.answer(
            b"\x02\x01\x01\0" + b"\x0c\0\0\0" + bytes(4) + b"\x14\0\0\0\x01\0\0\0"
        )
        bench.model.reply(CONTROL_IN, late)
        biases = bench.camera.read_biases()
        assert biases == {**dict.fromkeys(BIASES, 0), "bias_fo": 9}
        assert bench.count("control_recoveries") == 1


@pytest.mark.fault("no permission, busy")
def test_access_denied() -> None:
    """driver: one line, nothing claimed, tried again when asked; user reads: 'permission denied; install the udev rules of docs/hardware.md and plug in again'."""
    with CameraBench() as bench:
        bench.model.denied = True
        denied = "permission denied; install the udev rules"
        with pytest.raises(DeviceError, match=denied) as caught:
            bench.camera.open()
        one_line(caught.value)
        bench.model.denied = False
        bench.camera.open()


@pytest.mark.fault("no permission, busy")
def test_a_kernel_driver_holds_the_camera() -> None:
    """driver: detaches the kernel driver and gives it back on close; user reads: nothing."""
    with CameraBench() as bench:
        bench.model.kernel_driver = "uvcvideo"
        bench.camera.open()
        assert bench.model.kernel_driver is None
        bench.camera.close()
        assert bench.model.kernel_driver == "uvcvideo"


@pytest.mark.fault("host stalls")
def test_host_stalls(bench: CameraBench) -> None:
    """driver: goes on receiving in its own thread, with the time of the receipt, and loses nothing; user reads: queue_bytes in the diagnostics."""
    given, received_ns = b"", []
    for round_ in range(1, 6):
        given += bench.source.give(10)
        wait_until(lambda bytes_=80 * round_: bench.count("queue_bytes") == bytes_, "the receipt")
        received_ns.append(time.monotonic_ns())
    time.sleep(0.3)
    assert bench.count("queue_bytes") == len(given)
    assert bench.read(len(given)) == given
    last_ns, done = {}, 0
    for chunk in bench.chunks:
        done += len(chunk.data)
        last_ns[-(-done // 80) - 1] = chunk.arrival_ns
    assert all(last_ns[i] <= received_ns[i] for i in range(5))
    assert bench.count("drops") == 0


@pytest.mark.fault("two clients")
def test_two_clients(bench: CameraBench) -> None:
    """driver: the second program fails in one line, the first streams on; user reads: 'in use; close the other program, or unload the kernel driver that holds it'."""
    second = bench.driver()
    with pytest.raises(DeviceError, match="in use; close the other program") as caught:
        second.open()
    one_line(caught.value)
    second.close()
    bench.exchange()
    assert bench.count("losses") == 0


@pytest.mark.fault("shutdown at any time")
def test_shutdown_in_the_initialisation() -> None:
    """driver: closing cuts the 2.5 s of the initialisation short and releases the camera; user reads: 'closed before it was ready'."""
    with CameraBench() as bench:
        camera = bench.driver(sleep=None)
        with ThreadPoolExecutor() as pool:
            opening = pool.submit(camera.open)
            wait_until(lambda: bench.model.claims, "the claim")
            camera.close()
            error = opening.exception(DEADLINE_S)
        assert isinstance(error, DeviceError)
        assert "closed before it was ready" in one_line(error)
        assert not bench.model.claims


@pytest.mark.fault("shutdown at any time")
def test_shutdown_while_reconnecting() -> None:
    """driver: closing ends the search at once; user reads: nothing more."""
    before = set(threading.enumerate())
    with CameraBench() as bench:
        camera = bench.driver(attempts=None, sleep=None)
        camera.open()
        camera.start()
        bench.model.gone = True
        wait_until(lambda: camera.loss, "the loss")
        camera.close()
        camera.close()
        wait_until(lambda: set(threading.enumerate()) <= before, "the end of its threads")


@pytest.mark.fault("shutdown at any time")
def test_stop_at_the_end_of_a_search() -> None:
    """driver: stops the sensor that it has just started again; user reads: nothing more."""
    with CameraBench() as bench:
        camera = bench.driver(attempts=None)
        camera.open()
        camera.start()
        restarted, stopping = threading.Event(), threading.Event()
        restart = camera._restart

        def slow_restart(session: Any) -> None:
            restarted.set()
            assert stopping.wait(DEADLINE_S)
            restart(session)

        camera._restart = slow_restart
        bench.model.gone = True
        wait_until(lambda: camera.loss, "the loss")
        bench.model.gone = False
        assert restarted.wait(DEADLINE_S)
        threading.Timer(0.1, stopping.set).start()
        camera.stop()
        assert bench.model.watch.phase is not Phase.STREAMING
        camera.close()


@pytest.mark.fault("shutdown at any time")
def test_shutdown_while_the_camera_does_not_answer() -> None:
    """driver: closes within 2 s without any answer; user reads: nothing more."""
    with CameraBench(attempts=0) as bench:
        bench.streaming()
        bench.exchange()
        waits: list[float] = []

        def wait(condition: threading.Condition, seconds: float | None) -> bool:
            assert seconds is not None
            if threading.current_thread() is threading.main_thread():
                waits.append(seconds)
            return condition.wait(seconds)

        bench.model._wait = wait
        bench.model.mute = True
        bench.camera.close()
        print(f"waited {sum(waits):.2f} s for answers")
        assert sum(waits) < 1.0
        assert not bench.model.claims
