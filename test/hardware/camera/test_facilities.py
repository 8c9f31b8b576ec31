"""What the facilities write into the sensor, against the maker's register descriptions."""

from pathlib import Path

import pytest

from eschorty_ros.core.base.errors import ArgumentError, DeviceError, FormatError
from eschorty_ros.hardware.camera import event_rate, event_trail, monitors
from eschorty_ros.hardware.camera.anti_flicker import AntiFlicker, set_anti_flicker
from eschorty_ros.hardware.camera.biases import BIASES, BiasBank, load_bias_file, save_bias_file
from eschorty_ros.hardware.camera.pixel_selection import set_hot_pixels, set_windows, windows_of
from eschorty_ros.hardware.camera.settings import CameraSettings

FACTORY = {0x1004: 0x11A1_0053, 0x100C: 0x11A1_0000, 0x1010: 0x11A1_0066, 0x1018: 0x11A1_0049}


class RegisterFile:
    """Stores written values; ``always_set`` bits read as 1, writes are recorded in order."""

    def __init__(self, values: dict[int, int] | None = None) -> None:
        self.values = dict(values or {})
        self.always_set: dict[int, int] = {}
        self.writes: list[tuple[int, int]] = []

    def read(self, address: int) -> int:
        return self.values.get(address, 0) | self.always_set.get(address, 0)

    def write(self, address: int, value: int) -> None:
        assert 0 <= value <= 0xFFFF_FFFF
        self.values[address] = value
        self.writes.append((address, value))


@pytest.fixture
def registers() -> RegisterFile:
    return RegisterFile()


def bank() -> tuple[RegisterFile, BiasBank]:
    registers = RegisterFile({**FACTORY, 0x1020: 0x11A1_0014})
    return registers, BiasBank(registers)


def test_bias_is_an_offset_from_the_factory_trim() -> None:
    registers, biases = bank()
    assert biases.write("bias_diff_on", 20) == 20
    assert registers.values[0x1010] == 0x11A1_0000 | 0x66 + 20
    assert biases.write("bias_diff_on", -5) == -5
    assert biases.read()["bias_diff_on"] == -5
    assert biases.factory["bias_diff_on"] == 0x66


def test_bias_beyond_the_dac_reads_back_what_the_camera_holds() -> None:
    registers, biases = bank()
    assert biases.write("bias_fo", -150) == -0x53
    assert biases.write("bias_refr", 255) == 255 - 0x14
    assert registers.values[0x1020] & 0xFF == 255


@pytest.mark.parametrize("name", BIASES)
def test_bias_outside_its_range_is_refused(name: str) -> None:
    for wide, (low, high) in ((False, BIASES[name].normal), (True, BIASES[name].wide)):
        for offset in (low - 1, high + 1):
            with pytest.raises(ArgumentError, match=f"{name} is {offset}; choose {low} to {high}"):
                CameraSettings(biases={name: offset}, wide_biases=wide)


def test_bias_the_camera_does_not_keep_is_an_error() -> None:
    registers, biases = bank()
    registers.always_set[0x1010] = 0x80
    with pytest.raises(DeviceError, match="bias_diff_on was set to DAC 102 and reads back 230"):
        biases.write("bias_diff_on", 0)


def test_bias_file_round_trip_and_of_the_makers_tools(tmp_path: Path) -> None:
    offsets = {"bias_diff_on": 12, "bias_diff_off": -3, "bias_fo": 0, "bias_hpf": 9, "bias_refr": 1}
    save_bias_file(tmp_path / "a.bias", offsets)
    assert load_bias_file(tmp_path / "a.bias") == offsets
    path = tmp_path / "b.bias"
    path.write_text("% written by a tool\n0  % bias_diff\n20 % bias_diff_on\n\n-7 % bias_fo\n")
    assert load_bias_file(path) == {"bias_diff_on": 20, "bias_fo": -7}


@pytest.mark.parametrize("line", ["x % bias_fo", "12", "12 % contrast"])
def test_bias_file_with_a_wrong_line_names_it(tmp_path: Path, line: str) -> None:
    path = tmp_path / "c.bias"
    path.write_text(f"1 % bias_hpf\n{line}\n")
    with pytest.raises(FormatError, match=r"c\.bias line 2"):
        load_bias_file(path)


def test_event_rate_tables_and_limit() -> None:
    registers = RegisterFile({0x6000: 0x0015_5400, 0x602C: 0x2})
    event_rate.initialise(registers)
    assert registers.values[0x6000] == 0x0015_5401
    assert registers.values[0x602C] == 0x2
    assert registers.values[0x600C] == 4000
    assert registers.values[0x6400 + 4 * 255] == 511 << 16 | 510
    assert all(registers.values[0x6800 + 4 * i] == 0x0808_0808 for i in range(230))
    assert registers.values[0x6050] == 0
    assert event_rate.set_event_rate(registers, 100_000_000) == 100_000_000
    assert registers.values[0x6050] == 1
    assert registers.values[0x600C] == 20_000
    for rate in (0, 3_300_000_000):
        with pytest.raises(ArgumentError, match=f"erc_rate is {rate} "):
            event_rate.set_event_rate(registers, rate)
    assert event_rate.set_event_rate(registers, None) == 0
    assert registers.values[0x6050] == 0


def test_anti_flicker_band(registers: RegisterFile) -> None:
    registers.always_set[0xC0C4] = 1 << 2
    set_anti_flicker(registers, AntiFlicker(50, 520, band_pass=True))
    # 50 Hz is period 156, 520 Hz is 15.
    assert registers.values[0xC008] == 15 | 156 << 8 | 8 << 16
    assert registers.values[0xC004] == 4 | 6 << 3 | 1 << 6
    assert registers.values[0xC0C0] == 1630
    assert [value for address, value in registers.writes if address == 0xC000] == [5, 1]
    set_anti_flicker(registers, None)
    assert registers.values[0xC000] == 5
    assert AntiFlicker(90, 110).erases(100.0)
    assert not AntiFlicker(90, 110).erases(1000.0)
    assert not AntiFlicker(90, 110, band_pass=True).erases(100.0)


def test_anti_flicker_without_memory_is_named() -> None:
    with pytest.raises(DeviceError, match="anti-flicker filter is not ready"):
        set_anti_flicker(RegisterFile(), AntiFlicker())


@pytest.mark.parametrize(("low", "high"), [(49, 100), (100, 521), (200, 100)])
def test_anti_flicker_band_outside_the_sensor_is_refused(low: int, high: int) -> None:
    with pytest.raises(ArgumentError, match="anti-flicker band"):
        AntiFlicker(low, high)


@pytest.mark.parametrize(
    ("kind", "stc", "trail"),
    [
        ("trail", 0, 10_000 << 1 | 1),
        ("stc_cut_trail", 10_000 << 1 | 1, 0),
        ("stc_keep_trail", 1 << 24 | 10_000 << 1 | 1, 0),
    ],
)
def test_trail_filters(registers: RegisterFile, kind: str, stc: int, trail: int) -> None:
    assert event_trail.set_event_trail(registers, kind, 10_000) == 10_000
    assert registers.read(0xD004) == stc
    assert registers.read(0xD008) == trail
    # 10 ms: prescaler 13, multiplier 9, timeout 90.
    assert registers.values[0xD00C] == 13 | 9 << 5 | 1 << 16
    assert registers.values[0xD0C0] == 90 << 12
    assert registers.values[0xD000] == 1
    event_trail.clear_event_trail(registers)
    assert registers.values[0xD000] == 5


def test_trail_thresholds_are_whole_milliseconds(registers: RegisterFile) -> None:
    assert set(event_trail.TIMING) == set(range(1, 101))
    assert event_trail.set_event_trail(registers, "trail", 1_499) == 1_000
    assert event_trail.set_event_trail(registers, "trail", 99_500) == 100_000
    for threshold in (0, 999, 100_001):
        with pytest.raises(ArgumentError, match="trail_filter_threshold"):
            event_trail.set_event_trail(registers, "trail", threshold)
    with pytest.raises(ArgumentError, match="trail_filter_type"):
        event_trail.set_event_trail(registers, "median", 10_000)


def masked(registers: RegisterFile, first: int, count: int) -> list[int]:
    """Lines switched off (1 = off, line 32 k + b is bit b of word k)."""
    words = [registers.values[first + 4 * k] for k in range(-(-count // 32))]
    return [line for line in range(count) if words[line // 32] >> line % 32 & 1]


def test_roi_masks_are_the_product_of_columns_and_rows() -> None:
    registers = RegisterFile({0x4: 0xF000_5042})
    windows = windows_of([0, 100, 640, 10, 600, 300, 100, 20])
    set_windows(registers, windows)
    assert masked(registers, 0x2000, 1280) == list(range(700, 1280))
    on = [row for row in range(720) if row not in masked(registers, 0x4000, 720)]
    assert on == [*range(100, 110), *range(300, 320)]
    assert registers.values[0x4] == 0xF000_5042 | 1 << 1 | 1 << 5 | 1 << 6 | 1 << 10
    assert registers.values[0x4058] >> 16 == 0xFFFF


@pytest.mark.parametrize(
    "flat", [[0, 0, 10], [0, 0, 1281, 10], [-1, 0, 10, 10], [0, 710, 10, 11], [5, 5, 0, 5]]
)
def test_roi_outside_the_sensor_is_refused(flat: list[int]) -> None:
    with pytest.raises(ArgumentError, match="roi"):
        windows_of(flat)


def test_hot_pixels(registers: RegisterFile) -> None:
    set_hot_pixels(registers, [(3, 700), (1279, 0)])
    assert registers.values[0x9100] == 1 << 31 | 700 << 16 | 3
    assert registers.values[0x9104] == 1 << 31 | 1279
    assert registers.values[0x91FC] == 0
    with pytest.raises(ArgumentError, match="names 65 pixels"):
        set_hot_pixels(registers, [(0, 0)] * 65)
    with pytest.raises(ArgumentError, match="hot_pixels has 0,720; the sensor has 1280 columns"):
        set_hot_pixels(registers, [(0, 720)])


def test_packet_period_is_in_steps_of_16_us(registers: RegisterFile) -> None:
    assert monitors.set_packet_period(registers, 1008) == 1008
    assert monitors.set_packet_period(registers, 1000) == 992
    with pytest.raises(ArgumentError, match="mipi_frame_period is 8"):
        monitors.set_packet_period(registers, 8)


def test_trigger_input_keeps_the_other_bits() -> None:
    registers = RegisterFile({0x7004: 0xC000_0001})
    monitors.set_trigger_input(registers, True)
    assert registers.values[0x7004] == 0xC000_0401
    monitors.set_trigger_input(registers, False)
    assert registers.values[0x7004] == 0xC000_0001


def test_temperature() -> None:
    registers = RegisterFile({0x50: 420})
    with pytest.raises(DeviceError, match="temperature ADC is not ready"):
        monitors.read_temperature_c(registers, lambda _s: None)
    registers.always_set[0x50] = 1 << 11
    assert monitors.read_temperature_c(registers, lambda _s: None) == pytest.approx(23.8)
