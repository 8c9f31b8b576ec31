"""Devices of a served bench that are unplugged while drivers use them."""

import time

from benches import bench_here
from waiting import wait_until

from eschorty_ros.emulation.bench.folder import STAGE_PORT, usb_spec
from eschorty_ros.hardware.base.usb import open_backend
from eschorty_ros.hardware.camera import Evk4


def test_unplugged_devices_leave_the_bus_and_the_port_and_come_back() -> None:
    with bench_here(scene="plane") as (bench, folder):
        bus, port = open_backend(usb_spec(folder)), folder / STAGE_PORT

        def seen() -> tuple[int, bool]:
            return len(list(bus.enumerate_devices())), port.exists()

        bench.laser.gone = bench.stage.gone = True
        wait_until(lambda: seen() == (1, False), "laser and stage gone")
        bench.laser.replug()
        bench.stage.gone = False
        wait_until(lambda: seen() == (2, True), "laser and stage back")


def test_a_streaming_camera_that_was_unplugged_restarts_its_stream() -> None:
    with bench_here(scene="plane") as (bench, folder):
        camera = Evk4(open_backend(usb_spec(folder)), time.monotonic_ns)
        restarts: list[bool] = []

        def starts() -> int:
            chunk = camera.read(0.1)
            if chunk is not None:
                restarts.append(chunk.restarted)
            return sum(restarts)

        try:
            camera.open()
            camera.start()
            wait_until(lambda: len(restarts) > 5 or starts() > 1, "events")
            bench.camera.gone = True
            wait_until(lambda: camera.statistics()["losses"] == 1, "the loss")
            bench.camera.replug()
            wait_until(lambda: starts() == 2, "the stream's second beginning")
            statistics = camera.statistics()
        finally:
            camera.close()
        assert restarts[0]
        assert (statistics["losses"], statistics["reconnects"]) == (1, 1)


def test_events_of_a_bench_that_is_late_have_the_stamps_of_one_in_time() -> None:
    with bench_here(scene="plane") as (bench, folder):
        camera = Evk4(open_backend(usb_spec(folder)), time.monotonic_ns)
        try:
            camera.open()
            camera.start()
            wait_until(lambda: camera.read(0.1), "events")
            with bench.physics.lock:
                while camera.read(0.1) is not None:
                    pass
                stopped_ns = time.monotonic_ns()
                time.sleep(2.0)
            chunk = wait_until(lambda: camera.read(0.1), "the first events afterwards")
        finally:
            camera.close()
        late_s = (chunk.arrival_ns - stopped_ns) * 1e-9
        print(f"stamped {late_s:.3f} s after the bench stopped, received {2.0:g} s after it")
        assert late_s < 1.0
