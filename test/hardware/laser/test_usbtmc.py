"""USBTMC client on the emulated bus: checked headers, one request for a reply, recovery."""

from collections.abc import Iterator

import pytest
import usb.core
from hypothesis import given, settings
from hypothesis import strategies as st

from eschorty_ros.core.base.errors import (
    DeviceError,
    DeviceGoneError,
    DeviceStallError,
    DeviceTimeoutError,
)
from eschorty_ros.emulation.awg.model import ENDPOINT_IN, ENDPOINT_OUT, PACKET, AwgModel
from eschorty_ros.emulation.bus import EmulatedBackend
from eschorty_ros.hardware.laser.usbtmc import REPLY_LIMIT, UsbTmc, is_usbtmc


class Echo(AwgModel):
    """A generator that replies with ``reply_text`` to any query."""

    def __init__(self) -> None:
        super().__init__(lambda: 0, wait=lambda *_: False)
        self.reply_text = "0"
        self.requests = 0

    def _queried(self, path: str) -> str | None:
        return self.reply_text

    def _answer(self, tag: int, wanted: int) -> None:
        self.requests += 1
        super()._answer(tag, wanted)


@pytest.fixture
def model() -> Echo:
    return Echo()


@pytest.fixture
def link(model: Echo) -> Iterator[UsbTmc]:
    device = usb.core.find(backend=EmulatedBackend(lambda: [model]), custom_match=is_usbtmc)
    # Every wait of the model ends at once.
    link = UsbTmc(device, name="generator", timeout_s=60.0)
    yield link
    link.close()


def ask(link: UsbTmc) -> bytes:
    link.write(b"Q?\n")
    return link.read()


def test_reply_without_newline_is_one_request(link: UsbTmc, model: Echo) -> None:
    model.reply_text = "70.5"
    assert ask(link) == b"70.5"
    assert model.requests == 1


@settings(max_examples=60, deadline=None)
@given(
    length=st.one_of(st.integers(0, 400), st.integers(4080, 4200)),
    cut=st.sampled_from([0, 1, 5, 52, 64, 500]),
)
def test_replies_of_any_length_and_cut_are_joined(length: int, cut: int) -> None:
    model = Echo()
    device = usb.core.find(backend=EmulatedBackend(lambda: [model]), custom_match=is_usbtmc)
    link = UsbTmc(device, name="generator", timeout_s=0.05)
    model.reply_text = "abcdefghij"[: length % 10] + "x" * (length - length % 10)
    model.faults.transfer_bytes = cut
    assert ask(link) == model.reply_text.encode()
    link.close()


@pytest.mark.parametrize("packets", [1, 2, 5])
def test_reply_of_whole_packets_without_an_empty_one_does_not_block(
    link: UsbTmc, model: Echo, packets: int
) -> None:
    model.reply_text = "7" * (packets * PACKET - 12)
    assert ask(link) == model.reply_text.encode()
    assert ask(link) == model.reply_text.encode()


def test_reply_tags_run_round_without_zero(link: UsbTmc) -> None:
    for _ in range(400):
        assert ask(link) == b"0"


def test_endless_reply_is_refused(link: UsbTmc, model: Echo) -> None:
    model.reply_text = "x" * (REPLY_LIMIT + 5000)
    with pytest.raises(DeviceError, match="longer than 65536"):
        ask(link)
    link.clear()
    model.reply_text = "1"
    assert ask(link) == b"1"


@pytest.mark.parametrize(
    ("fault", "kind", "text"),
    [
        ("wrong_tags", DeviceError, "wrong tag for its request; check cable and hub"),
        ("wrong_kinds", DeviceError, "wrong message id, 3,"),
        ("short_headers", DeviceError, "too short; check cable and hub"),
        ("oversized", DeviceError, "announced 101 bytes and brought 1"),
        ("lost_replies", DeviceTimeoutError, "ETIMEDOUT"),
    ],
)
def test_bad_reply_is_refused_and_the_next_is_good(
    link: UsbTmc, model: Echo, fault: str, kind: type[DeviceError], text: str
) -> None:
    setattr(model.faults, fault, 1)
    with pytest.raises(kind, match=text):
        ask(link)
    link.clear()
    assert ask(link) == b"0"


@pytest.mark.parametrize("endpoint", [ENDPOINT_IN, ENDPOINT_OUT])
@pytest.mark.parametrize("knows_clear", [True, False])
def test_stall_is_cleared_on_both_endpoints(
    link: UsbTmc, model: Echo, endpoint: int, knows_clear: bool
) -> None:
    model.faults.no_clear = not knows_clear
    model.stalled.add(endpoint)
    with pytest.raises(DeviceStallError):
        ask(link)
    model.stalled |= {ENDPOINT_IN, ENDPOINT_OUT}
    link.clear()
    assert not model.stalled
    if knows_clear:
        assert ask(link) == b"0"


def test_clear_waits_until_the_instrument_is_done(link: UsbTmc, model: Echo) -> None:
    model.faults.pending_clears = 5
    link.clear()
    assert model.faults.pending_clears == 0
    model.faults.pending_clears = 10_000
    with pytest.raises(DeviceError, match="does not end clearing"):
        link.clear()


def test_empty_packet_before_a_reply_is_skipped(link: UsbTmc, model: Echo) -> None:
    model.faults.empty_packets = 1
    assert ask(link) == b"0"


def test_unplugged_has_an_error_of_its_own(link: UsbTmc, model: Echo) -> None:
    model.gone = True
    with pytest.raises(DeviceGoneError, match="generator: sending a command"):
        ask(link)
    with pytest.raises(DeviceGoneError):
        link.clear()
