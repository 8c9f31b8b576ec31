"""SCPI layer: any reply is a value of the kind that was requested, or a typed error."""

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eschorty_ros.core.base.errors import DeviceError, DeviceTimeoutError
from eschorty_ros.hardware.laser.awg_profile import load_profile
from eschorty_ros.hardware.laser.scpi import Scpi
from eschorty_ros.hardware.laser.usbtmc import UsbTmc

PROFILE = load_profile("utg900e")


class Answering(UsbTmc):
    """A link that gives prepared replies and records what it is called with."""

    def __init__(self, *replies: bytes | DeviceError) -> None:
        self.replies = list(replies)
        self.written: list[bytes] = []
        self.clears = 0
        self.counters = {"faults": 0, "retries": 0}

    def write(self, message: bytes) -> None:
        self.written.append(message)

    def read(self) -> bytes:
        reply = self.replies.pop(0)
        if isinstance(reply, DeviceError):
            raise reply
        return reply

    def clear(self) -> None:
        self.clears += 1


def scpi(link: Answering) -> Scpi:
    return Scpi(link, PROFILE, lambda: None, link.counters)


@pytest.mark.parametrize(
    ("name", "reply", "value"),
    [
        ("output", b"ON", True),
        ("output", b"1\r\n", True),
        ("output", b"off", False),
        ("output", b"0\n", False),
        ("frequency", b"70", 70.0),
        ("frequency", b"7.0E+1", 70.0),
        ("frequency", b"70.5Hz", 70.5),
        ("frequency", b"1.5 kHz", 1500.0),
        ("low", b"-0.05", -0.05),
        ("high", b"10mV", 0.01),
        ("waveform", b"SQU", "SQU"),
        ("waveform", b'"SQUare"', "SQUARE"),
    ],
)
def test_replies_as_instruments_write_them(name: str, reply: bytes, value: object) -> None:
    assert scpi(Answering(reply)).get(name, 1) == pytest.approx(value)


@pytest.mark.parametrize("reply", [b"70 mHg", b"1,5", b"70 70", b"nan", b"", b"0x10"])
def test_reply_that_is_no_number_is_refused(reply: bytes) -> None:
    with pytest.raises(DeviceError, match="which is no number"):
        scpi(Answering(reply, reply)).get("frequency", 1)


@settings(deadline=None)
@given(st.binary(max_size=40), st.sampled_from(["output", "frequency", "waveform"]))
def test_any_reply_is_a_value_or_a_typed_error(reply: bytes, name: str) -> None:
    link = Answering(reply, reply)
    kind = {"output": bool, "frequency": float, "waveform": str}[name]
    value, refusal = None, ""
    try:
        value = scpi(link).get(name, 1)
    except DeviceError as error:
        refusal = str(error)
    assert isinstance(value, kind) != bool(refusal)
    assert "\n" not in refusal
    assert link.clears == (2 if refusal else 0)


def test_one_fault_is_retried_two_are_raised() -> None:
    fault = DeviceTimeoutError("no answer")
    link = Answering(fault, b"ON")
    layer = scpi(link)
    assert layer.get("output", 1) is True
    assert (link.counters, link.clears) == ({"faults": 1, "retries": 1}, 1)
    assert link.written == [b":CHANnel1:OUTPut?\n"] * 2
    link.replies[:] = [fault, fault]
    with pytest.raises(DeviceTimeoutError, match="no answer"):
        layer.get("output", 1)


@pytest.mark.parametrize(
    ("value", "text"),
    [(70.0, b"70"), (0.000001, b"0.000001"), (19_999.5, b"19999.5"), (2e7, b"20000000")],
)
def test_numbers_are_plain_decimals(value: float, text: bytes) -> None:
    link = Answering()
    scpi(link).set("frequency", value, 1)
    assert link.written == [b":CHANnel1:BASE:FREQuency " + text + b"\n"]


def test_a_switch_has_the_words_of_its_setting() -> None:
    words = replace(PROFILE.settings["inversion"], on="INVerted", off="NORMal")
    profile = replace(PROFILE, settings={**PROFILE.settings, "inversion": words})
    other = Scpi(
        Answering(b"NORM", b"INVERTED"), profile, lambda: None, {"faults": 0, "retries": 0}
    )
    assert other.spelt("inversion", False, 2).endswith(" NORMAL")
    assert other.spelt("output", False, 2).endswith(" OFF")
    assert [other.get("inversion", 2), other.get("inversion", 2)] == [False, True]
