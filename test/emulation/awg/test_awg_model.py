"""The generator model: parses, ignores and clamps as the instrument does."""

import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from output_log import read_output_log

from eschorty_ros.emulation.awg.model import ENDPOINT_IN, ENDPOINT_OUT, AwgModel
from eschorty_ros.emulation.bus import UsbFault

Exchange = Callable[[str], str]


@pytest.fixture
def model() -> AwgModel:
    return AwgModel(lambda: 7, wait=lambda *_: False)


@pytest.fixture
def exchange(model: AwgModel) -> Exchange:
    """Sends a message composed here; returns the reply to a query."""

    def exchanged(text: str) -> str:
        data = text.encode()
        head = struct.pack("<BBBBIB3x", 1, 5, 0xFA, 0, len(data), 1)
        model.bulk_out(ENDPOINT_OUT, head + data + bytes(-len(data) % 4), 0)
        if "?" not in text:
            return ""
        model.bulk_out(ENDPOINT_OUT, struct.pack("<BBBBIB3x", 2, 6, 0xF9, 0, 1000, 0), 0)
        reply = model.bulk_in(ENDPOINT_IN, 4096, 0)
        assert struct.unpack_from("<BBBBIB3x", reply) == (2, 6, 0xF9, 0, len(reply) - 12, 1)
        return reply[12:].decode()

    return exchanged


@pytest.mark.parametrize(
    ("command", "query", "reply"),
    [
        (":CHANnel1:BASE:FREQuency 70.5\n", ":CHANnel1:BASE:FREQuency?", "70.5"),
        (":CHAN1:BASE:FREQ 1234.567891\n", ":chan1:base:freq?", "1234.567891"),
        (":CHAN2:OUTP ON\n", ":CHANnel2:OUTPut?", "ON"),
        (":CHAN1:BASE:WAV SQU\n", ":CHAN1:BASE:WAVe?", "SQUARE"),
        (":CHAN1:LIM:UPP 5;:CHAN1:LIM:ENAB ON\n", ":CHAN1:LIM:UPPer?", "5"),
        (":CHAN1:MOD AM\n", ":CHAN1:MODe?", "AM"),
        ("", "*IDN?", "UNI-T,UTG962E,AWG1234567890,V1.08"),
        ("", ":SYST:LOCK?", "ON"),
        (":SYSTem:LOCK OFF\n", ":CHAN1:LOAD?", "10000"),
    ],
)
def test_long_and_short_forms(exchange: Exchange, command: str, query: str, reply: str) -> None:
    exchange(command)
    assert exchange(query + "\n") == reply


@pytest.mark.parametrize(
    "command",
    [
        ":CHAN1:BASE:FREQ 6e1", ":CHAN1:BASE:FREQ 70000000", ":CHAN1:BASE:DUTY 0",
        ":CHAN1:BASE:DUTY 100", ":CHAN1:BASE:HIGH 11", ":CHAN1:BASE:HIGH -1",
        ":CHAN1:BASE:WAVe TRIANGLE", ":CHAN1:OUTPut MAYBE", ":CHAN3:OUTPut ON",
        ":CHAN1:BASE:FREQU 5",
        ":NONSENSE 1", "",
    ],
)  # fmt: skip
def test_command_out_of_range_or_unknown_is_ignored(
    model: AwgModel, exchange: Exchange, command: str
) -> None:
    before = [vars(channel).copy() for channel in model.channels]
    exchange(command + "\n")
    assert [vars(channel) for channel in model.channels] == before


def test_clamp_holds_levels_and_the_load_scales_volts(model: AwgModel, exchange: Exchange) -> None:
    for text in ("LIM:LOW 0", "LIM:UPP 5", "LIM:ENAB ON", "BASE:HIGH 8", "BASE:LOW -3"):
        exchange(f":CHAN1:{text}\n")
    assert (model.channels[0].high_v, model.channels[0].low_v) == (5.0, 0.0)
    exchange(":CHAN1:LOAD 50\n")
    assert exchange(":CHAN1:BASE:HIGH?\n") == "2.5"


def test_replies_have_no_newline_and_come_only_where_one_is_due(
    model: AwgModel, exchange: Exchange
) -> None:
    assert not exchange("*IDN?\n").endswith("\n")
    with pytest.raises(UsbFault, match="ETIMEDOUT"):
        exchange(":SYSTem:ERRor?\n")


def test_any_command_locks_the_panel(model: AwgModel, exchange: Exchange) -> None:
    assert model.touch("OUTPut", "ON")
    exchange("*IDN?\n")
    assert not model.touch("OUTPut", "OFF")
    exchange(":SYST:LOCK OFF\n")
    assert model.touch("OUTPut", "OFF")


def test_reset_and_power_up_switch_off(model: AwgModel, exchange: Exchange) -> None:
    for restart in (lambda: exchange("*RST\n"), model.reboot, model.replug):
        exchange(":CHAN1:OUTP ON\n")
        assert model.output
        restart()
        assert not model.output
        assert model.channels[0].frequency_hz == 1000.0


def test_every_change_is_logged_and_reported_once(tmp_path: Path) -> None:
    log = tmp_path / "laser.log"
    model = AwgModel(lambda: 7, log, wait=lambda *_: False)
    changes: list[tuple[int, bool, float]] = []
    model.on_change = lambda t_ns, lit, wave: changes.append((t_ns, lit, wave.frequency_hz))
    for path, text in (
        ("BASE:WAVe", "SQU"), ("BASE:HIGH", "5"), ("OUTPut", "ON"), ("OUTPut", "ON"),
        ("BASE:FREQuency", "70"), ("BASE:HIGH", "1"), ("OUTPut", "OFF"),
    ):  # fmt: skip
        assert model.touch(path, text)
    lines = read_output_log(log)
    assert [state for _, state in lines] == ["OFF", "ON", "OFF"]
    assert [t_ns for t_ns, _ in lines] == sorted(t_ns for t_ns, _ in lines)
    # Sine to square while off, on, 70 Hz, and a level too low for light.
    assert changes == [(7, False, 1000.0), (7, True, 1000.0), (7, True, 70.0), (7, False, 70.0)]
