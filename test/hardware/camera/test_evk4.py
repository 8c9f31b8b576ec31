"""The driver on the emulated camera: life cycle, settings, read-back."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from evk4_bench import SERIAL, CameraBench, OnDemand
from waiting import DEADLINE_S, wait_until

from eschorty_ros.core.base.errors import ArgumentError, DeviceError, DeviceGoneError
from eschorty_ros.emulation.bus import EmulatedBackend
from eschorty_ros.emulation.evk4 import BoardIdentity, Evk4Model, Phase
from eschorty_ros.hardware.camera import AntiFlicker, CameraSettings, Evk4


def test_open_start_stop_close_follow_the_sequences_and_waits_of_the_sensor() -> None:
    now_ns = [0]

    def sleep(seconds: float) -> None:
        now_ns[0] += round(seconds * 1e9)

    model = Evk4Model(OnDemand(), clock_ns=lambda: now_ns[0], wait=lambda *_: False)
    camera = Evk4(EmulatedBackend(lambda: [model]), lambda: now_ns[0], sleep=sleep)
    camera.open()
    assert model.watch.phase is Phase.READY
    assert now_ns[0] > 2.5e9
    camera.start()
    assert model.watch.phase is Phase.STREAMING
    camera.stop()
    assert model.watch.phase is Phase.READY
    camera.start()
    camera.close()
    assert model.watch.phase is Phase.OFF
    assert model.watch.violations == []
    assert not model.claims


def test_old_firmware_is_refused() -> None:
    model = Evk4Model(OnDemand(), board=BoardIdentity(firmware=0x030700), wait=lambda *_: False)
    camera = Evk4(EmulatedBackend(lambda: [model]), time.monotonic_ns, sleep=lambda _s: None)
    with pytest.raises(DeviceError, match=r"firmware is 3\.7\.0, 3\.8\.0 is the oldest"):
        camera.open()
    assert not model.claims


def test_another_sensor_is_refused_and_stays_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    with CameraBench() as bench:
        written: list[int] = []
        monkeypatch.setattr(bench.model, "read", lambda _address: 0x30501C01)
        monkeypatch.setattr(bench.model, "write", lambda address, _value: written.append(address))
        with pytest.raises(DeviceError, match=r"not answer as an IMX636 .*0014 reads 30501C01"):
            bench.camera.open()
        assert not written
        assert not bench.model.claims


def test_slow_link_is_a_warning() -> None:
    with CameraBench() as bench:
        object.__setattr__(bench.model.identity, "speed", 3)
        bench.camera.open()
        assert ["slower than USB 3" in line for line in bench.camera.warnings] == [True]


def test_serial_chooses_among_cameras() -> None:
    with CameraBench(serial=0xABCDEF01) as bench:
        bench.bus.append(Evk4Model(OnDemand(), board=BoardIdentity(), wait=lambda *_: False))
        with pytest.raises(DeviceError, match="2 devices match"):
            bench.camera.open()
        chosen = bench.driver(serial="ABCDEF01")
        chosen.open()
        assert chosen.identity.serial == "abcdef01"
        chosen.close()
        missing = bench.driver(serial="00000077")
        with pytest.raises(DeviceGoneError, match=r"serial 00000077.*abcdef01, 00051234"):
            missing.open()
        assert not bench.model.claims


def test_events_arrive_in_order_and_start_at_zero() -> None:
    with CameraBench() as bench:
        bench.model.stale(b"\xff\xff" * 600)
        bench.streaming()
        bench.exchange(50)
        bench.exchange(7)
        assert bench.chunks[0].restarted
        assert not any(chunk.gap or chunk.restarted for chunk in bench.chunks[1:])
        stamps = [chunk.arrival_ns for chunk in bench.chunks]
        assert stamps == sorted(stamps)
        wait_until(lambda: bench.camera.healthy, "health")
        bench.camera.stop()
        assert not bench.camera.healthy
        assert not bench.source.running
        bench.camera.start()
        bench.chunks.clear()
        bench.exchange(3)
        assert bench.chunks[0].restarted
        assert bench.model.watch.violations == []


def test_settings_reach_the_sensor() -> None:
    settings = CameraSettings(
        biases={"bias_diff_on": 20, "bias_fo": -10},
        packet_period_us=2000,
        erc_rate=50_000_000,
        anti_flicker=AntiFlicker(90, 110),
        trail_filter="stc_cut_trail",
        trail_threshold_us=7_000,
        windows=((0, 100, 1280, 50),),
        hot_pixels=((3, 700),),
        trigger_input=True,
    )
    with CameraBench(settings=settings) as bench:
        bench.camera.open()
        seen = bench.model.settings
        biases = dict(seen.biases)
        assert (biases["bias_diff_on"], biases["bias_fo"], biases["bias_hpf"]) == (20, -10, 0)
        assert seen.packet_period_us == 2000
        assert seen.event_rate == (10_000, 200)
        assert seen.flicker_band_hz == pytest.approx((90, 110), rel=0.02)
        assert seen.noise_filter == ("stc", 7_000)
        assert seen.columns_off == frozenset()
        assert seen.rows_off == frozenset(range(720)) - frozenset(range(100, 150))
        assert seen.pixels_off == {(3, 700)}
        assert seen.trigger_in
        values = bench.camera.statistics()
        assert values["bias_diff_on"] == 20
        assert values["packet_period_us"] == 2000
        assert values["trail_threshold_us"] == 7_000


def test_default_settings_leave_the_pixels_alone() -> None:
    with CameraBench() as bench:
        bench.camera.open()
        seen = bench.model.settings
        assert {offset for _, offset in seen.biases} == {0}
        assert (seen.event_rate, seen.flicker_band_hz, seen.noise_filter) == (None,) * 3
        assert not seen.trigger_in
        assert seen.columns_off | seen.rows_off | seen.pixels_off == frozenset()
        assert seen.packet_period_us == 4000


def test_windows_are_set_while_streaming(bench: CameraBench) -> None:
    bench.camera.set_windows([(10, 100, 1200, 50)])
    seen = bench.model.settings
    assert seen.rows_off == frozenset(range(720)) - frozenset(range(100, 150))
    assert frozenset(range(1280)) - seen.columns_off == frozenset(range(10, 1210))
    bench.camera.set_windows([])
    seen = bench.model.settings
    assert seen.rows_off | seen.columns_off == frozenset()
    bench.exchange()
    assert bench.model.watch.violations == []


def test_bias_is_set_and_read_back_while_streaming(bench: CameraBench) -> None:
    assert bench.camera.set_bias("bias_refr", 30) == 30
    assert dict(bench.model.settings.biases)["bias_refr"] == 30
    assert bench.camera.read_biases()["bias_refr"] == 30
    with pytest.raises(ArgumentError, match="bias_refr is 236; choose -20 to 235"):
        bench.camera.set_bias("bias_refr", 236)
    bench.exchange()
    assert bench.model.watch.violations == []


def test_temperature_is_read_while_streaming() -> None:
    with CameraBench() as bench:
        bench.model.registers.temperature_c = 41.0
        bench.streaming()

        def measured() -> bool:
            bench.source.give(1)
            return bench.camera.statistics()["temperature_c"] == pytest.approx(41.0, abs=0.2)

        wait_until(measured, "a temperature")


def test_a_scene_without_events_is_no_failure(bench: CameraBench) -> None:
    bench.exchange()
    before = bench.count("control_requests")
    wait_until(lambda: bench.count("control_requests") > before + 3, "requests to the camera")
    wait_until(lambda: bench.camera.healthy, "health")
    bench.exchange()
    assert (bench.count("losses"), bench.count("gaps")) == (0, 0)


def test_bytes_dropped_by_a_full_queue_are_counted_and_marked() -> None:
    with CameraBench(queue_bytes=400) as bench:
        bench.streaming()
        size = 0
        for _ in range(40):
            size += len(bench.source.give(5))
            wait_until(
                lambda size=size: bench.count("dropped_bytes") + bench.count("queue_bytes") == size,
                "bytes",
            )
        assert bench.count("dropped_bytes") >= 1200
        kept = b""
        while chunk := bench.camera.read(0.0):
            kept += chunk.data
            assert not chunk.gap
        assert len(kept) + bench.count("dropped_bytes") == 1600
        bench.exchange(1)
        assert bench.chunks[0].gap
        assert bench.count("gaps") == 1


def test_stop_ends_a_waiting_read(bench: CameraBench) -> None:
    with ThreadPoolExecutor() as pool:
        reading = pool.submit(bench.camera.read, 2 * DEADLINE_S)
        bench.camera.stop()
        assert reading.result(DEADLINE_S) is None


def test_a_hung_receiving_thread_is_an_error_and_no_second_one_starts(bench: CameraBench) -> None:
    released = threading.Event()
    session = bench.camera._connection.session
    reading = threading.Event()

    def hang(_timeout_s: float) -> tuple[bytes, int]:
        reading.set()
        released.wait(DEADLINE_S)
        return b"", 0

    session.reader.read = hang  # type: ignore[method-assign]
    assert reading.wait(DEADLINE_S)
    with pytest.raises(DeviceError, match="do not end"):
        bench.camera.stop()
    with pytest.raises(DeviceError, match="have not ended"):
        bench.camera.start()
    released.set()
    assert [thread.name for thread in threading.enumerate()].count("EVK4 events") <= 1


def test_a_closed_camera_refuses_every_call() -> None:
    bench = CameraBench()
    bench.camera.open()
    bench.camera.close()
    bench.camera.close()
    for action in (bench.camera.open, bench.camera.start, lambda: bench.camera.read(0.0)):
        with pytest.raises(DeviceError, match=f"{SERIAL:08x} is closed; open it again"):
            action()
