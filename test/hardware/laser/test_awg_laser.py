"""The laser's generator: off by default, enabled only as configured and read back."""

import dataclasses
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
from awg_bench import SQUARE, AwgBench

from eschorty_ros.core.base.errors import ArgumentError, DeviceError
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.emulation.awg.model import ENDPOINT_OUT
from eschorty_ros.hardware.base.protocols import DeviceIdentity, LaserOutput
from eschorty_ros.hardware.laser.awg import AwgLaser, open_laser
from eschorty_ros.hardware.laser.awg_settings import AwgSettings

ROOT = Path(__file__).parents[3]


@pytest.fixture
def bench(tmp_path: Path) -> AwgBench:
    return AwgBench(tmp_path / "laser.log")


def sets(bench: AwgBench) -> list[str]:
    """Commands that change something, without their channel prefix."""
    return [c.removeprefix(":CHANnel1:") for c in bench.model.commands if "?" not in c]


def test_construction_switches_a_lit_generator_off(bench: AwgBench) -> None:
    bench.model.touch("OUTPut", "ON")
    bench.model.touch("OUTPut", "ON", channel=2)
    laser = bench.laser()
    assert next(iter(bench.model.commands)) == ":CHANnel1:OUTPut OFF"
    assert [channel.output for channel in bench.model.channels] == [False, False]
    assert laser.readback().output is LaserOutput.OFF
    assert bench.outputs() == ["OFF", "ON", "OFF"]


def test_identity_is_read_from_the_generator(bench: AwgBench) -> None:
    assert bench.laser().identity == DeviceIdentity("UNI-T UTG962E", "AWG1234567890", "V1.08")


def test_settings_are_made_in_the_safe_order(bench: AwgBench) -> None:
    laser = bench.laser()
    bench.model.commands.clear()
    laser.configure(Modulation(1234.5, 0.25, "square"))
    assert sets(bench) == [
        "OUTPut OFF",
        ":CHANnel2:OUTPut OFF",
        "BASE:LOW 0",
        "BASE:HIGH 0.01",
        ":SYSTem:LOCK OFF",
        # Whether it has bursts is tried at the first configuring.
        "MODe BURST",
        "BURSt:TYPe NCYC",
        "TRIGger:SOURce MANUAL",
        "BURSt:CYCLes 2",
        "BURSt:PHASe 270",
        "AMPLitude:UNIT VPP",
        "LOAD 10000",
        "LIMit:LOWer 0",
        "LIMit:UPPer 5",
        "LIMit:ENABle ON",
        "MODe BURST",
        "INVersion OFF",
        "BASE:WAVe SQUARE",
        "BASE:FREQuency 1234.5",
        "BASE:HIGH 5",
        "BASE:LOW 0",
        "BASE:DUTY 25",
        "BURSt:TYPe NCYC",
        "TRIGger:SOURce MANUAL",
        "BURSt:CYCLes 555",
        "BURSt:PHASe 225",
        ":SYSTem:LOCK OFF",
    ]
    state = bench.model.channels[0]
    assert (state.frequency_hz, state.duty_percent, state.wave) == (1234.5, 25.0, "SQUARE")
    assert (state.high_v, state.low_v, state.limit_upper_v) == (5.0, 0.0, 5.0)
    assert not bench.model.lit


def test_a_unit_that_was_left_at_the_panel_is_set_back(bench: AwgBench) -> None:
    bench.model.touch("AMPLitude:UNIT", "VRMS")
    bench.lit_laser()
    assert bench.model.channels[0].amplitude_unit == "VPP"


def test_one_command_per_message(bench: AwgBench, monkeypatch: pytest.MonkeyPatch) -> None:
    messages: list[str] = []
    execute = bench.model._execute
    monkeypatch.setattr(
        bench.model, "_execute", lambda text: (messages.append(text), execute(text))
    )
    bench.lit_laser().disable()
    assert all(text.count("\n") == 1 and ";" not in text for text in messages)


def test_enable_reads_all_back_before_and_the_output_after(bench: AwgBench) -> None:
    laser = bench.ready_laser()
    bench.model.commands.clear()
    laser.enable()
    sent = list(bench.model.commands)
    on = sent.index(":CHANnel1:OUTPut ON")
    assert sent[on - 1] == ":SYSTem:LOCK OFF"
    assert {
        "AMPLitude:UNIT?",
        "LOAD?",
        "LIMit:UPPer?",
        "BASE:HIGH?",
        "BASE:DUTY?",
        "INVersion?",
    } <= {text.removeprefix(":CHANnel1:") for text in sent[:on]}
    assert sent[on + 1 :] == ["*TRG", ":CHANnel1:OUTPut?", ":SYSTem:LOCK OFF"]


def test_levels_can_be_set_from_any_others(bench: AwgBench) -> None:
    for low, high in ((0.0, 5.0), (2.0, 3.0), (0.0, 1.0), (1.5, 4.0)):
        laser = bench.laser(low_v=low, high_v=high)
        laser.configure(SQUARE)
        state = bench.model.channels[0]
        assert (state.low_v, state.high_v) == (low, high)
        laser.close()


def test_volts_stay_volts_whatever_the_load_was(bench: AwgBench) -> None:
    bench.model.touch("LOAD", "50")
    bench.ready_laser(high_v=3.3)
    assert bench.model.channels[0].high_v == 3.3
    assert bench.model.channels[0].load_ohm == 10000.0


def test_off_again_and_again_is_off(bench: AwgBench) -> None:
    laser = bench.lit_laser()
    for _ in range(3):
        laser.disable()
    laser.close()
    laser.close()
    laser.disable()
    assert bench.outputs() == ["OFF", "ON", "OFF"]
    assert bench.model.channels[0].high_v == 0.01
    with pytest.raises(DeviceError, match="closed; open it again"):
        laser.configure(SQUARE)


def test_configured_while_on_it_is_off_in_between_and_on_again(bench: AwgBench) -> None:
    laser = bench.lit_laser()
    laser.configure(Modulation(1000.0))
    assert bench.outputs() == ["OFF", "ON", "OFF", "ON"]
    assert bench.model.channels[0].frequency_hz == 1000.0
    assert laser.readback().modulation.frequency_hz == 1000.0
    with pytest.raises(ArgumentError, match="sine has none"):
        laser.configure(Modulation(1000.0, 0.3, "sine"))
    assert bench.model.lit


def test_readback_has_the_time_of_the_switch_and_no_phase(bench: AwgBench) -> None:
    laser = bench.ready_laser()
    bench.clock.now_ns += 5_000
    laser.enable()
    readback = laser.readback()
    assert (readback.output, readback.output_since_ns) == (LaserOutput.ON, bench.clock.now_ns)
    assert readback.modulation == SQUARE


def test_warns_of_another_model_and_goes_on(bench: AwgBench, tmp_path: Path) -> None:
    profile, other = ROOT / "config" / "awg_utg900e.yaml", tmp_path / "awg_other.yaml"
    other.write_text(profile.read_text().replace("(?i)utg", "(?i)sdg"))
    laser = bench.laser(profile=str(other))
    (warning,) = laser.readback().warnings
    assert "UTG962E" in warning
    assert "check every setting" in warning
    assert laser.readback().warnings == (warning,)


@pytest.mark.parametrize("policy", ["best_effort", "off"])
def test_write_only_generator_works_without_read_back(bench: AwgBench, policy: str) -> None:
    bench.model.faults.lost_replies = 10**9
    laser = bench.lit_laser(readback=policy)
    assert laser.readback().output is LaserOutput.ON
    laser.disable()
    assert not bench.model.output
    assert laser.readback().output is LaserOutput.OFF
    assert laser.readback().counters["write_only"] == 1.0
    asked = [c for c in bench.model.commands if "?" in c]
    assert len(asked) == (0 if policy == "off" else 2)
    assert any("not verified" in w for w in laser.readback().warnings) == (policy == "best_effort")


def test_best_effort_still_refuses_what_contradicts(bench: AwgBench) -> None:
    bench.model.faults.ignored = {"BASE:DUTY"}
    laser = bench.laser(readback="best_effort")
    with pytest.raises(DeviceError, match="duty is 50 instead of 30"):
        laser.configure(Modulation(70.0, 0.3))


def disable_at(
    bench: AwgBench, laser: AwgLaser, command: str, monkeypatch: pytest.MonkeyPatch
) -> tuple[threading.Thread, list[str]]:
    """Disable from another thread once the generator gets ``command``; also what it gets then."""
    disabling = threading.Thread(target=laser.disable)
    execute = bench.model._execute
    after: list[str] = []

    def executing(text: str) -> None:
        execute(text)
        if disabling.ident is not None:
            after.append(text.strip())
        elif command in text:
            disabling.start()
            while not laser._in_flight.disabling_now:
                pass

    monkeypatch.setattr(bench.model, "_execute", executing)
    return disabling, after


def test_disabling_interrupts_the_command_in_progress(
    bench: AwgBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    laser = bench.ready_laser()
    disabling, after = disable_at(bench, laser, "BASE:FREQuency 500", monkeypatch)
    with pytest.raises(DeviceError, match="switched off meanwhile"):
        laser.configure(Modulation(500.0))
    disabling.join()
    assert after[0] == ":CHANnel1:OUTPut OFF"
    assert not any(" 25" in text or "OUTPut ON" in text for text in after)
    with pytest.raises(DeviceError, match="not armed"):
        laser.enable()


@pytest.mark.parametrize("operation", ["readback", "enable"])
def test_interrupted_light_can_be_switched_on_again(
    bench: AwgBench, monkeypatch: pytest.MonkeyPatch, operation: str
) -> None:
    laser = bench.ready_laser()
    if operation == "readback":
        laser.enable()
    disabling, _ = disable_at(bench, laser, "BASE:FREQuency?", monkeypatch)
    with pytest.raises(DeviceError, match="switched off meanwhile"):
        getattr(laser, operation)()
    disabling.join()
    assert not bench.model.lit
    laser.arm()
    laser.enable()
    assert bench.model.lit


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"high_v": 6.0}, "high_v is 6 V, above high_max_v, 5 V"),
        ({"low_v": -0.1}, "low_v is -0.1"),
        ({"low_v": 5.0}, "not below high_v"),
        ({"high_v": float("nan")}, "high_v is nan"),
        ({"high_max_v": 24.0}, "high_max_v is 24.0"),
        ({"readback": "maybe"}, "choose one of required, best_effort, off"),
        ({"vendor_ids": "UNI-T"}, "write hexadecimal numbers"),
        ({"channel": 1.5}, "channel is 1.5"),
        ({"load_ohm": 0.0}, "load_ohm is 0.0"),
    ],
)
def test_bad_settings_are_one_line(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(ArgumentError, match=text) as caught:
        AwgSettings(**changes)
    assert "\n" not in str(caught.value)


def test_a_profile_whose_dark_level_is_out_of_bounds_leaves_the_generator_free(
    bench: AwgBench, tmp_path: Path
) -> None:
    text = (ROOT / "config" / "awg_utg900e.yaml").read_text()
    profile = tmp_path / "awg_wrong.yaml"
    text = text.replace("dark_high_v: 0.01", "dark_high_v: 20.0")
    profile.write_text(text.replace("dark_limit_v: 0.1", "dark_limit_v: 20.0"))
    with pytest.raises(ArgumentError, match="high is 20; the generator takes -10 to 10") as kept:
        bench.laser(profile=str(profile))
    # The error keeps what raised it, which would release the generator when it is collected.
    assert kept.value.__traceback__
    bench.laser().close()


def test_channel_beyond_the_generator_is_refused(bench: AwgBench) -> None:
    with pytest.raises(ArgumentError, match="channel is 3; the generator has 2"):
        bench.laser(channel=3)


def test_second_channel_gates_alone(bench: AwgBench) -> None:
    laser = bench.ready_laser(channel=2)
    laser.enable()
    assert [channel.output for channel in bench.model.channels] == [False, True]
    laser.close()
    assert [channel.output for channel in bench.model.channels] == [False, False]


def test_opened_by_keywords(bench: AwgBench) -> None:
    laser = open_laser(**dataclasses.asdict(bench.settings()))
    assert laser.readback().output is LaserOutput.OFF
    with pytest.raises(ArgumentError, match="see AwgSettings"):
        open_laser(colour="red")


def test_stall_while_switching_on_leaves_the_output_off(bench: AwgBench, monkeypatch: Any) -> None:
    laser = bench.ready_laser()
    execute = bench.model._execute

    def stalls(text: str) -> None:
        execute(text)
        if "OUTPut ON" in text:
            bench.model.stalled.add(ENDPOINT_OUT)
            bench.model.faults.lost_replies = 2

    monkeypatch.setattr(bench.model, "_execute", stalls)
    with pytest.raises(DeviceError):
        laser.enable()
    assert not bench.model.output
    assert laser.readback().output is LaserOutput.OFF


def test_driver_starts_without_numpy_and_ros() -> None:
    code = (
        "import sys, eschorty_ros.hardware.laser.awg as a;"
        "a.load_profile('utg900e');"
        "print(sorted({'numpy', 'numba', 'rclpy', 'scipy'} & set(sys.modules)))"
    )
    found = subprocess.check_output([sys.executable, "-c", code], text=True, cwd=ROOT)
    assert found.strip() == "[]"


def test_switched_off_and_on_again_without_configuring(bench: AwgBench) -> None:
    laser = bench.lit_laser()
    for _ in range(2):
        laser.disable()
        assert bench.model.channels[0].high_v < 0.1
        laser.arm()
        laser.enable()
        assert bench.model.lit
        assert bench.model.channels[0].high_v == 5.0
