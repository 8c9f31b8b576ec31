"""The alternative driver: its package is real, the camera behind it is not."""

# ruff: noqa: E402 - without the package the file skips before it imports what needs it
from __future__ import annotations

from typing import Any

import pytest

neuromorphic_drivers = pytest.importorskip(
    "neuromorphic_drivers", reason="neuromorphic-drivers is not installed"
)

from neuromorphic_drivers import Connection, ListedDevice, Name
from neuromorphic_drivers.status import RawRingStatus, RawStatus

from eschorty_ros.core.errors import ArgumentError, DeviceError
from eschorty_ros.hardware.camera.anti_flicker import AntiFlicker
from eschorty_ros.hardware.camera.neuromorphic import NeuromorphicEvk4
from eschorty_ros.hardware.camera.settings import CameraSettings


class Camera:
    """A device as the package hands it out, with scripted packets."""

    def __init__(self) -> None:
        self.script: list[tuple[bytes | None, dict[str, Any]] | Exception] = []
        self.configurations: list[Any] = []
        self.options: dict[str, Any] = {}
        self.closed = 0
        self.cleared = 0

    def open(self, **options: Any) -> Camera:
        self.options = options
        self.configurations.append(options["configuration"])
        return self

    def __next__(self) -> tuple[RawStatus, bytes | None]:
        step = self.script.pop(0) if self.script else (None, {})
        if isinstance(step, Exception):
            raise step
        data, ring = step
        if data is None:
            return RawStatus(system_time=10.0, ring=None), None
        whole = {
            "system_time": 9.75,
            "backlog": 0,
            "raw_packets": 1,
            "clutch_engaged": False,
            "overflow_indices": None,
            "dropped_packets": 0,
        }
        return RawStatus(system_time=10.0, ring=RawRingStatus(**(whole | ring))), data

    def clear_backlog(self, _until: int) -> None:
        self.cleared += 1

    def update_configuration(self, configuration: Any) -> None:
        self.configurations.append(configuration)

    def temperature_celsius(self) -> float:
        return 38.5

    def close(self) -> None:
        self.closed += 1


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> Camera:
    device = Camera()
    listed = ListedDevice(Name.PROPHESEE_EVK4, Connection.USB_SUPER, "1-2", "00051234", None)
    monkeypatch.setattr(neuromorphic_drivers, "list_devices", lambda: [listed])
    monkeypatch.setattr(neuromorphic_drivers, "open", device.open)
    return device


def test_raw_bytes_come_with_their_arrival_and_gaps(device: Camera) -> None:
    camera = NeuromorphicEvk4(lambda: 5_000_000_000)
    camera.open()
    assert camera.identity.serial == "00051234"
    assert device.options["raw"] is True
    camera.start()
    assert camera.healthy
    device.script = [
        (b"abcd", {}),
        (None, {}),
        (b"ef", {"overflow_indices": [0]}),
        (b"gh", {"dropped_packets": 2}),
    ]
    chunks = [camera.read(0.1) for _ in range(4)]
    got = [(c.data, c.arrival_ns, c.gap, c.restarted) for c in chunks if c is not None]
    assert got == [
        (b"abcd", 4_750_000_000, False, True),
        (b"ef", 4_750_000_000, True, False),
        (b"gh", 4_750_000_000, True, False),
    ]
    assert camera.statistics()["gaps"] == 2
    camera.close()
    camera.close()
    assert device.closed == 1
    with pytest.raises(DeviceError, match="is closed"):
        camera.read(0.0)


def test_settings_become_the_package_s_configuration(device: Camera) -> None:
    settings = CameraSettings(biases={"bias_fo": -5}, erc_rate=50_000_000, trigger_input=True)
    camera = NeuromorphicEvk4(lambda: 0, "51234", settings)
    camera.open()
    first = device.configurations[0]
    assert (first.biases.fo, first.biases.diff_on) == (-5, 0)
    assert first.rate_limiter.maximum_events_per_period == 10_000
    assert first.enable_external_trigger
    assert first.serialize()
    assert camera.set_bias("bias_diff_on", 30) == 30
    assert device.configurations[-1].biases.diff_on == 30
    assert device.configurations[-1].biases.fo == -5
    camera.close()


def test_lost_camera_is_one_line(device: Camera) -> None:
    camera = NeuromorphicEvk4(lambda: 0)
    camera.open()
    camera.start()
    device.script = [RuntimeError("no\ndevice")]
    with pytest.raises(DeviceError, match="00051234: lost \\(no device\\); check cable") as caught:
        camera.read(0.1)
    assert "\n" not in str(caught.value)
    assert not camera.healthy


def test_absent_camera_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = NeuromorphicEvk4(lambda: 0, "77")
    monkeypatch.setattr(neuromorphic_drivers, "list_devices", list)
    with pytest.raises(DeviceError, match="none with serial 77 can be opened, there is no camera"):
        camera.open()


def test_bus_that_cannot_be_listed_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails() -> list[Any]:
        raise RuntimeError("Other error")

    monkeypatch.setattr(neuromorphic_drivers, "list_devices", fails)
    with pytest.raises(DeviceError, match=r"cannot be listed \(Other error\)"):
        NeuromorphicEvk4(lambda: 0).open()


@pytest.mark.parametrize(
    "settings",
    [
        CameraSettings(windows=((0, 0, 10, 10),)),
        CameraSettings(trail_filter="trail"),
        CameraSettings(anti_flicker=AntiFlicker()),
        CameraSettings(hot_pixels=((1, 1),)),
    ],
    ids=["roi", "trail_filter", "anti_flicker", "hot_pixels"],
)
def test_what_it_lacks_is_refused(settings: CameraSettings) -> None:
    with pytest.raises(ArgumentError, match="driver neuromorphic has none; use driver evk4"):
        NeuromorphicEvk4(lambda: 0, "", settings)
