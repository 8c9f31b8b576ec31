"""The emulated EVK4 against the protocol, with requests written as bytes."""

import errno
import struct
from itertools import pairwise

import numpy as np
import pytest
import usb.core

from eschorty_ros.core import evt3
from eschorty_ros.emulation.bus import EmulatedBackend
from eschorty_ros.emulation.evk4 import (
    CONTROL_IN,
    CONTROL_OUT,
    DATA_IN,
    SEQUENCES,
    BoardIdentity,
    Evk4Model,
    Phase,
)

READ, WRITE = 0x10102, 0x40010102


class Words:
    """A source of prepared words, one piece per read."""

    def __init__(self, *pieces):
        self.pieces = [np.asarray(piece, "<u2").tobytes() for piece in pieces]
        self.calls = []

    def start(self):
        self.calls.append("start")

    def stop(self):
        self.calls.append("stop")

    def read(self, max_bytes, timeout_s):
        return self.pieces.pop(0) if self.pieces else b""


class Host:
    """Uses the model over pyusb, without the driver."""

    def __init__(self, source=None, **options):
        self.source = source or Words()
        self.model = Evk4Model(self.source, wait=lambda *_: False, **options)
        self.device = usb.core.find(backend=EmulatedBackend(lambda: [self.model]))

    def request(self, property_, *words):
        self.device.write(
            CONTROL_OUT, struct.pack(f"<{2 + len(words)}I", property_, 4 * len(words), *words)
        )
        answer = self.device.read(CONTROL_IN, 1024).tobytes()
        head = struct.unpack_from("<II", answer)
        assert head[1] == len(answer) - 8
        return head[0], answer[8:]

    def read(self, address):
        kind, payload = self.request(READ, 0, address, 1)
        assert kind == READ
        device, echoed, value = struct.unpack("<3I", payload)
        assert (device, echoed) == (0, address)
        return value

    def write(self, address, value):
        kind, payload = self.request(WRITE, 0, address, value)
        assert (kind, struct.unpack("<3I", payload)) == (WRITE, (0, address, value))

    def run(self, *names, pause=lambda ns: None):
        for name in names:
            for step in SEQUENCES[name]:
                kept = self.read(step.address) & ~step.mask
                self.write(step.address, kept & 0xFFFFFFFF | step.value)
                pause(step.wait_ns)

    def data(self):
        return self.device.read(DATA_IN, 128 << 10).tobytes()

    def all_data(self):
        """Everything there is, packet by packet."""
        got = b""
        while True:
            try:
                got += self.data()
            except usb.core.USBTimeoutError:
                if not self.source.pieces:
                    return got


def words(data):
    return [f"{word:04X}" for word in np.frombuffer(data, "<u2")]


def test_the_board_reports_its_identity():
    host = Host(board=BoardIdentity(serial=0x1_0005_1234))
    device = host.device
    assert (device.idVendor, device.idProduct, device.speed) == (0x04B4, 0x00F5, 4)
    interface = device.get_active_configuration()[(0, 0)]
    assert (interface.bInterfaceClass, interface.bInterfaceSubClass) == (0xFF, 0x19)
    assert [e.bEndpointAddress for e in interface] == [0x82, 0x02, 0x81]
    assert host.request(0x72) == (0x72, struct.pack("<Q", 0x1_0005_1234))
    assert host.request(0x79) == (0x79, struct.pack("<I", 0x030900))
    assert host.request(0x10000) == (0x10000, struct.pack("<I", 1))
    assert (host.read(0x14), host.read(0xF128) & 3) == (0xA0401806, 0)


@pytest.mark.parametrize(
    ("request_words", "expected"),
    [
        ((0x12345,), (0x80000000,)),
        ((READ, 1, 0x14, 1), (READ | 0x80000000, 1, 0x14, errno.ENODEV)),
        ((READ, 0, 0x15, 1), (READ | 0x80000000, 0, 0x15, errno.EINVAL)),
        ((READ, 0, 0x14, 253), (READ | 0x80000000, 0, 0x14, errno.EINVAL)),
        ((READ, 0), (READ | 0x80000000, 0, 0, errno.EINVAL)),
    ],
)
def test_refused_requests_answer_with_the_errno(request_words, expected):
    kind, payload = Host().request(*request_words)
    assert (kind, *struct.unpack(f"<{len(payload) // 4}I", payload)) == expected


def test_a_request_whose_size_is_wrong_is_refused():
    host = Host()
    host.device.write(CONTROL_OUT, struct.pack("<III", READ, 99, 0))
    answer = host.device.read(CONTROL_IN, 1024).tobytes()
    assert struct.unpack_from("<I", answer)[0] == READ | 0x80000000


def test_bursts_cover_consecutive_registers():
    host = Host()
    host.request(WRITE, 0, 0x6800, 1, 2, 3)
    assert struct.unpack("<5I", host.request(READ, 0, 0x6800, 3)[1]) == (0, 0x6800, 1, 2, 3)


def test_it_streams_only_after_init_and_start_in_order():
    host = Host(Words([0x8000, 0x6001, 0x0001, 0x2001]))
    host.run("start")
    assert host.model.watch.phase is Phase.OFF
    assert host.model.watch.violations == ["start while off"]
    with pytest.raises(usb.core.USBTimeoutError):
        host.data()
    host.model.watch.violations.clear()
    host.run("stop", "destroy", "init", "start")
    assert host.model.watch.phase is Phase.STREAMING
    assert words(host.data()) == ["8000", "6001", "0001", "2001"]
    host.run("stop")
    assert host.model.watch.phase is Phase.READY
    host.run("start", "stop", "destroy")
    assert host.source.calls == ["start", "stop", "start", "stop"]
    assert host.model.watch.violations == []


def test_a_sequence_out_of_order_is_named_and_has_no_effect():
    host = Host()
    for step in SEQUENCES["init"][:5]:
        host.write(step.address, step.value)
    host.write(0xB040, 0)
    host.run("start")
    assert host.model.watch.phase is Phase.OFF
    assert host.model.watch.violations[0] == "init step 6: B004=A expected, B040=0 came"


def test_destroy_while_streaming_ends_the_stream_and_is_a_violation():
    host = Host()
    host.run("init", "start", "destroy")
    assert host.source.calls == ["start", "stop"]
    assert host.model.watch.violations == ["destroy while streaming"]


def test_short_waits_are_violations():
    now = [0]
    host = Host(clock_ns=lambda: now[0])

    def pause(ns):
        now[0] += ns

    host.run("init", pause=pause)
    assert host.model.watch.violations == []
    host.run("init", pause=lambda ns: pause(ns if ns != 500_000_000 else ns - 1000))
    assert host.model.watch.violations == ["init step 2: wait 500000 us was 1 us too short"]


def test_init_resets_the_sensor_to_its_factory_trim():
    host = Host()
    host.run("init")
    assert host.read(0x1004) & 0xFF == 0x53
    host.write(0x1004, 0x11A10000 | 0x53 - 20)
    assert dict(host.model.settings.biases)["bias_fo"] == -20
    host.run("init")
    assert dict(host.model.settings.biases)["bias_fo"] == 0


def test_a_packet_of_whole_usb_packets_ends_with_an_empty_one():
    full = [0x8000, 0x6001, *[0x0001] * 510]
    host = Host(Words(full, [0x8001, 0x6000]))
    host.run("init", "start")
    assert len(host.data()) == 1024
    assert words(host.data()) == ["8001", "6000"]


def test_nothing_is_lost_or_reordered_however_the_pieces_fall():
    rng = np.random.default_rng(5)
    times = np.cumsum(rng.integers(1, 40, 20_000))
    stream = []
    for before, t in pairwise([-1, *times]):
        if t >> 12 != before >> 12:
            stream.append(0x8000 | t >> 12)
        stream += [0x6000 | t & 0xFFF, 0x0001, 0x2000 | int(rng.integers(1280))]
    cuts = np.sort(rng.integers(0, len(stream), 40))
    host = Host(Words(*np.split(np.array(stream), cuts)))
    host.run("init", "start")
    assert host.all_data() == np.array(stream, "<u2").tobytes()


def test_triggers_come_only_while_the_input_is_enabled():
    host = Host(Words([0x8000, 0x6064, 0xA001, 0x2001], [0x8000, 0x6065, 0xA000, 0x2002]))
    host.run("init", "start")
    assert words(host.data()) == ["8000", "6064", "A001", "2001"]
    host.write(0x7004, host.read(0x7004) & ~(1 << 10))
    assert words(host.data()) == ["8000", "6065", "2002"]


def test_stale_data_stays_until_it_is_read_and_time_restarts_with_a_start():
    host = Host(Words([0x8003, 0x6001, 0x2001], [0x8000, 0x6002, 0x2002]))
    host.model.stale(b"\x01\x20")
    host.run("init", "start")
    host.device.clear_halt(DATA_IN)
    assert words(host.data()) == ["2001"]
    assert words(host.data()) == ["8003", "6001", "2001"]
    host.run("stop", "start")
    assert words(host.data()) == ["8000", "6002", "2002"]


def test_masked_pixels_give_no_events_and_all_others_do():
    rng = np.random.default_rng(8)
    n = 30_000
    t, p = rng.integers(0, 50, n) * 1000, rng.integers(0, 2, n, dtype=np.uint8)
    x, y = rng.integers(0, 200, n, dtype=np.uint16), rng.integers(300, 340, n, dtype=np.uint16)
    t, x, y, p = evt3.sort_readout(t, x, y, p)
    stream = evt3.Encoder().encode(t, x, y, p)
    cuts = np.sort(rng.integers(0, len(stream) // 2, 9))
    host = Host(Words(*np.split(np.frombuffer(stream, "<u2"), cuts)))
    host.run("init", "start")
    host.write(0x2000, 0x0000FF00)
    host.write(0x4000 + 4 * (310 // 32), 1 << 310 % 32)
    host.write(0x9100, 1 << 31 | 320 << 16 | 100)
    events = evt3.Decoder().decode(host.all_data())
    on = ((x < 8) | (x > 15)) & (y != 310) & ~((x == 100) & (y == 320))
    for field, expected in (("t", t), ("x", x), ("y", y), ("p", p)):
        assert np.array_equal(getattr(events, field), expected[on])


def test_replug_comes_back_reset():
    host = Host(Words([0x8000, 0x6001]))
    host.run("init", "start")
    host.model.replug()
    assert host.source.calls == ["start", "stop"]
    with pytest.raises(usb.core.USBError) as caught:
        host.data()
    assert caught.value.errno == errno.ENODEV
    assert host.model.watch.phase is Phase.OFF
