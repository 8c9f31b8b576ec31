"""The driver on the emulated camera: life cycle, settings, read-back."""

from __future__ import annotations

import threading
import time

import pytest
from evk4_bench import PATIENCE_S, SERIAL, OnDemand, Rig, until

from eschorty_ros.core.base.errors import ArgumentError, DeviceError, DeviceGoneError
from eschorty_ros.emulation.bus.usb_backend import EmulatedBackend
from eschorty_ros.emulation.evk4.model import Evk4Model
from eschorty_ros.emulation.evk4.sequences import Phase
from eschorty_ros.emulation.evk4.treuzell import BoardIdentity
from eschorty_ros.hardware.camera.anti_flicker import AntiFlicker
from eschorty_ros.hardware.camera.evk4 import Evk4
from eschorty_ros.hardware.camera.settings import CameraSettings


def test_life_cycle_keeps_every_order_and_wait_of_the_sensor() -> None:
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


def test_identity_comes_from_the_camera() -> None:
    with Rig() as rig:
        rig.camera.open()
        identity = rig.camera.identity
        assert (identity.serial, identity.firmware) == ("00051234", "3.9.0")


def test_old_firmware_is_refused() -> None:
    model = Evk4Model(OnDemand(), board=BoardIdentity(firmware=0x030700), wait=lambda *_: False)
    camera = Evk4(EmulatedBackend(lambda: [model]), time.monotonic_ns, sleep=lambda _s: None)
    with pytest.raises(DeviceError, match=r"firmware is 3\.7\.0, 3\.8\.0 is the oldest"):
        camera.open()
    assert not model.claims


def test_slow_link_is_told() -> None:
    with Rig() as rig:
        object.__setattr__(rig.model.identity, "speed", 3)
        rig.camera.open()
        assert ["slower than USB 3" in line for line in rig.camera.warnings] == [True]


def test_serial_chooses_among_cameras() -> None:
    with Rig(serial=0xABCDEF01) as rig:
        rig.bus.append(Evk4Model(OnDemand(), board=BoardIdentity(), wait=lambda *_: False))
        with pytest.raises(DeviceError, match="2 devices match"):
            rig.camera.open()
        chosen = rig.driver(serial="ABCDEF01")
        chosen.open()
        assert chosen.identity.serial == "abcdef01"
        chosen.close()
        missing = rig.driver(serial="00000077")
        with pytest.raises(DeviceGoneError, match=r"serial 00000077.*abcdef01, 00051234"):
            missing.open()
        assert not rig.model.claims


def test_events_arrive_in_order_and_start_at_zero() -> None:
    with Rig() as rig:
        rig.model.stale(b"\xff\xff" * 600)
        rig.streaming()
        rig.exchange(50)
        rig.exchange(7)
        assert rig.chunks[0].restarted
        assert not any(chunk.gap or chunk.restarted for chunk in rig.chunks[1:])
        stamps = [chunk.arrival_ns for chunk in rig.chunks]
        assert stamps == sorted(stamps)
        until(lambda: rig.camera.healthy, "health")
        rig.camera.stop()
        assert not rig.camera.healthy
        assert not rig.source.running
        rig.camera.start()
        rig.chunks.clear()
        rig.exchange(3)
        assert rig.chunks[0].restarted
        assert rig.model.watch.violations == []


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
    with Rig(settings=settings) as rig:
        rig.camera.open()
        seen = rig.model.settings
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
        values = rig.camera.statistics()
        assert values["bias_diff_on"] == 20
        assert values["packet_period_us"] == 2000
        assert values["trail_threshold_us"] == 7_000


def test_default_settings_leave_the_pixels_alone() -> None:
    with Rig() as rig:
        rig.camera.open()
        seen = rig.model.settings
        assert {offset for _, offset in seen.biases} == {0}
        assert (seen.event_rate, seen.flicker_band_hz, seen.noise_filter) == (None,) * 3
        assert not seen.trigger_in
        assert seen.packet_period_us == 1008


def test_bias_is_set_and_read_back_while_streaming() -> None:
    with Rig() as rig:
        rig.streaming()
        assert rig.camera.set_bias("bias_refr", 30) == 30
        assert dict(rig.model.settings.biases)["bias_refr"] == 30
        assert rig.camera.read_biases()["bias_refr"] == 30
        with pytest.raises(ArgumentError, match="bias_refr is 236; choose -20 to 235"):
            rig.camera.set_bias("bias_refr", 236)
        rig.exchange()
        assert rig.model.watch.violations == []


def test_temperature_is_read_while_streaming() -> None:
    with Rig() as rig:
        rig.model.registers.temperature_c = 41.0
        rig.streaming()

        def measured() -> bool:
            rig.source.give(1)
            return rig.camera.statistics()["temperature_c"] == pytest.approx(41.0, abs=0.2)

        until(measured, "a temperature")


def test_darkness_is_no_failure() -> None:
    with Rig() as rig:
        rig.streaming()
        rig.exchange()
        asked = rig.count("control_requests")
        until(lambda: rig.count("control_requests") > asked + 3, "a question to the dark camera")
        until(lambda: rig.camera.healthy, "health")
        rig.exchange()
        assert (rig.count("losses"), rig.count("gaps")) == (0, 0)


def test_packet_loss_in_a_full_queue_is_counted_and_told() -> None:
    with Rig(queue_bytes=400) as rig:
        rig.streaming()
        rig.source.give(200)
        until(lambda: rig.count("dropped_bytes") + rig.count("queue_bytes") == 1600, "the flood")
        assert rig.count("dropped_bytes") >= 1200
        kept = b""
        while chunk := rig.camera.read(0.0):
            kept += chunk.data
            assert not chunk.gap
        assert len(kept) + rig.count("dropped_bytes") == 1600
        rig.exchange(1)
        assert rig.chunks[0].gap
        assert rig.count("gaps") == 1


def test_readers_wait_is_ended_by_stop() -> None:
    with Rig() as rig:
        rig.streaming()
        got: list[object] = []
        reader = threading.Thread(target=lambda: got.append(rig.camera.read(30.0)))
        reader.start()
        rig.camera.stop()
        reader.join(PATIENCE_S)
        assert got == [None]


def test_a_receiving_thread_that_hangs_gets_no_second_one_beside_it() -> None:
    before = set(threading.enumerate())
    with Rig() as rig:
        rig.streaming()
        released = threading.Event()
        session = rig.camera._connection.session
        assert session is not None
        reading = threading.Event()

        def hang(_timeout_s: float) -> tuple[bytes, int]:
            reading.set()
            released.wait(PATIENCE_S)
            return b"", 0

        session.reader.read = hang  # type: ignore[method-assign]
        assert reading.wait(PATIENCE_S)
        with pytest.raises(DeviceError, match="do not end"):
            rig.camera.stop()
        with pytest.raises(DeviceError, match="have not ended"):
            rig.camera.start()
        released.set()
        receiving = [t for t in set(threading.enumerate()) - before if t.name == "EVK4 events"]
        assert len(receiving) <= 1


def test_closed_camera_says_so() -> None:
    rig = Rig()
    rig.camera.open()
    rig.camera.close()
    rig.camera.close()
    for action in (rig.camera.open, rig.camera.start, lambda: rig.camera.read(0.0)):
        with pytest.raises(DeviceError, match=f"{SERIAL:08x} is closed; open it again"):
            action()
