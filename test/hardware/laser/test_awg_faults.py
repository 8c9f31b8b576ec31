"""Faults of the laser's generator: what the driver does, and what its user reads."""

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from awg_bench import SQUARE, AwgBench

from eschorty_ros.core.base.errors import DeviceError, DeviceGoneError
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.emulation.awg.model import ENDPOINT_IN, ENDPOINT_OUT, AwgModel
from eschorty_ros.hardware.base.protocols import LaserOutput
from eschorty_ros.hardware.laser import awg


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> AwgBench:
    # No wait takes time here: a stall of the host must not prevent a later try.
    monkeypatch.setattr(awg, "OFF_LIMIT_S", 600.0)
    return AwgBench(tmp_path / "laser.log")


@pytest.mark.fault("USB unplugged")
def test_generator_unplugged_while_lit(bench: AwgBench) -> None:
    """driver: counts as on, stays refused, off as soon as it is back; user reads: laser state unknown ... switch the generator off by hand."""  # noqa: E501
    laser = bench.lit_laser()
    bench.model.gone = True
    with pytest.raises(DeviceError, match=r"laser state unknown: .*the device is gone") as caught:
        laser.readback()
    assert "switch the generator off by hand" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert laser.readback().output is LaserOutput.UNKNOWN
    with pytest.raises(DeviceError, match=r"laser state unknown: .*no such device"):
        laser.disable()
    laser.arm()
    with pytest.raises(DeviceError, match="not configured"):
        laser.enable()
    # The cable alone was out: the generator kept its output on.
    kept = bench.model.channels
    bench.model.replug()
    bench.model.channels = kept
    assert bench.model.output
    laser.disable()
    assert not bench.model.output
    assert laser.readback().output is LaserOutput.OFF
    laser.configure(SQUARE)
    laser.arm()
    laser.enable()
    assert bench.model.lit


@pytest.mark.fault("USB unplugged")
def test_another_generator_comes_back(bench: AwgBench) -> None:
    """driver: refuses a generator with another serial; user reads: no such device with serial ... on the bus; there is ..."""  # noqa: E501
    laser = bench.lit_laser()
    bench.model.gone = True
    other = AwgModel(bench.clock, serial="AWG0000000002", wait=lambda *_: False)
    bench.models.append(other)
    with pytest.raises(DeviceError, match=r"with serial AWG1234567890.*there is AWG0000000002"):
        laser.disable()
    assert not other.commands


@pytest.mark.parametrize("endpoint", [ENDPOINT_IN, ENDPOINT_OUT])
@pytest.mark.fault("endpoint stalls")
def test_one_stall_is_recovered(bench: AwgBench, endpoint: int) -> None:
    """driver: clears both endpoints, sends once more, counts; user reads: nothing, faults 1 in diagnostics."""  # noqa: E501
    laser = bench.lit_laser()
    bench.model.stalled.add(endpoint)
    assert laser.readback().output is LaserOutput.ON
    assert not bench.model.stalled
    assert bench.model.lit
    assert (laser.readback().counters["faults"], laser.readback().counters["retries"]) == (1, 1)


@pytest.mark.fault("endpoint stalls")
def test_second_stall_is_an_error(bench: AwgBench, monkeypatch: pytest.MonkeyPatch) -> None:
    """driver: no third try, off, confirmed after opening again; user reads: ... the device stalled the transfer."""  # noqa: E501
    laser = bench.lit_laser()
    clear_halt, reset = bench.model.clear_halt, bench.model.reset

    def resets() -> None:
        monkeypatch.setattr(bench.model, "clear_halt", clear_halt)
        reset()

    monkeypatch.setattr(bench.model, "clear_halt", lambda endpoint: None)
    monkeypatch.setattr(bench.model, "reset", resets)
    bench.model.stalled.add(ENDPOINT_IN)
    with pytest.raises(DeviceError, match="stalled the transfer"):
        laser.readback()
    assert not bench.model.output
    assert laser.readback().output is LaserOutput.OFF


@pytest.mark.fault("no answer, time-out")
def test_mute_generator(bench: AwgBench) -> None:
    """driver: tries clear, reset, a new opening, then gives up within its bound; user reads: laser state unknown: ... no answer in time."""  # noqa: E501
    laser = bench.lit_laser()
    bench.model.mute = True
    with pytest.raises(DeviceError, match=r"laser state unknown: .*no answer in time"):
        laser.disable()
    assert laser.readback().output is LaserOutput.UNKNOWN
    assert laser.readback().counters["switch_off_failures"] == 1
    bench.model.mute = False
    laser.disable()
    assert bench.outputs() == ["OFF", "ON", "OFF"]


@pytest.mark.parametrize("fault", ["mute", "lost_replies"])
@pytest.mark.fault("no answer, time-out")
def test_disabling_waits_two_seconds_at_most(fault: str) -> None:
    """driver: the sum of all waits of a disabling that fails is bounded; user reads: laser state unknown within 2 s."""  # noqa: E501
    waits: list[float] = []
    bench = AwgBench()
    bench.model = AwgModel(bench.clock, wait=lambda _, seconds: bool(waits.append(seconds)))
    bench.models[:] = [bench.model]
    laser = bench.lit_laser()
    waits.clear()
    if fault == "mute":
        bench.model.mute = True
    else:
        bench.model.faults.lost_replies = 10**9
    with pytest.raises(DeviceError, match="laser state unknown"):
        laser.disable()
    assert sum(waits) < 2.0


@pytest.mark.fault("no answer, time-out")
def test_replies_lost(bench: AwgBench) -> None:
    """driver: refuses a setting that cannot be read back, and switches off; user reads: ... no answer in time."""  # noqa: E501
    laser = bench.ready_laser()
    bench.model.faults.lost_replies = 2
    with pytest.raises(DeviceError, match="no answer in time"):
        laser.enable()
    assert not bench.model.output
    assert laser.readback().output is LaserOutput.OFF


@pytest.mark.parametrize(
    "fault", ["wrong_tags", "wrong_kinds", "short_headers", "oversized", "empty_packets"]
)
@pytest.mark.fault("malformed transfer")
def test_bad_reply_header(bench: AwgBench, fault: str) -> None:
    """driver: drops it, clears, reads again; user reads: nothing, faults 1 in diagnostics."""
    laser = bench.lit_laser()
    setattr(bench.model.faults, fault, 1)
    assert laser.readback().output is LaserOutput.ON
    assert bench.model.lit
    assert laser.readback().counters["faults"] == (0 if fault == "empty_packets" else 1)


@pytest.mark.fault("malformed transfer")
def test_bad_reply_headers_without_end(bench: AwgBench) -> None:
    """driver: accepts no reply to another request, and switches off; user reads: laser state unknown: ... a reply header has the wrong tag ..."""  # noqa: E501
    laser = bench.lit_laser()
    bench.model.faults.wrong_tags = 10**9
    with pytest.raises(DeviceError, match=r"laser state unknown.*a reply header has the wrong tag"):
        laser.readback()
    assert not bench.model.output
    assert laser.readback().output is LaserOutput.UNKNOWN


@pytest.mark.parametrize("newline", [False, True])
@pytest.mark.parametrize("size", [0, 1, 5])
@pytest.mark.fault("partial reply")
def test_reply_in_pieces(bench: AwgBench, size: int, newline: bool) -> None:
    """driver: joins up to the end of message, strips line ends; user reads: nothing."""
    bench.model.faults.transfer_bytes = size
    bench.model.faults.newline = newline
    laser = bench.lit_laser()
    assert laser.readback().output is LaserOutput.ON
    assert laser.readback().counters["faults"] == 0


@pytest.mark.fault("stale reply")
def test_stale_reply_after_a_time_out(bench: AwgBench) -> None:
    """driver: clears before it reads again, so no reply is taken for another; user reads: nothing, faults 1 in diagnostics."""  # noqa: E501
    laser = bench.lit_laser()
    bench.model.faults.late_replies = 1
    assert laser.readback().output is LaserOutput.ON
    assert laser.readback().counters["faults"] == 1
    assert not bench.model._replies


@pytest.mark.fault("stale reply")
def test_stale_reply_that_survives_clearing(bench: AwgBench) -> None:
    """driver: refuses a stale reply of another kind, reads again; user reads: nothing, faults 1 in diagnostics."""  # noqa: E501
    laser = bench.lit_laser()
    bench.model._replies.append(b"SQUARE")
    assert laser.readback().output is LaserOutput.ON
    assert laser.readback().counters["faults"] == 1


@pytest.fixture
def profile(tmp_path: Path) -> str:
    """A profile of a generator with an error queue."""
    path = tmp_path / "awg_queue.yaml"
    text = (Path(__file__).parents[3] / "config" / "awg_utg900e.yaml").read_text("utf-8")
    path.write_text(f'{text}error_queue: ":SYSTem:ERRor?"\n', "utf-8")
    return str(path)


def test_a_generator_without_an_error_queue_is_asked_for_none(bench: AwgBench) -> None:
    laser = bench.laser()
    laser.configure(SQUARE)
    assert not [c for c in bench.model.commands if "ERR" in c]
    assert laser.readback().counters["faults"] == 0


@pytest.mark.parametrize("errors", [None, [], ['-222,"Data out of range"', '-113,"Undefined"']])
@pytest.mark.fault("error queue")
def test_error_queue(bench: AwgBench, profile: str, errors: list[str] | None) -> None:
    """driver: reads it once at opening, no reply means none, empties it; user reads: a warning per entry."""  # noqa: E501
    bench.model.errors = None if errors is None else type(bench.model.commands)(errors)
    laser = bench.laser(profile=profile)
    warnings = laser.readback().warnings
    assert len(warnings) == len(errors or [])
    assert all(error in text for error, text in zip(errors or [], warnings, strict=True))
    laser.configure(SQUARE)
    asked = [c for c in bench.model.commands if "ERR" in c]
    assert len(asked) == 1 + len(errors or [])


@pytest.mark.fault("error queue")
def test_error_queue_whose_probe_cannot_be_cleared(bench: AwgBench, profile: str) -> None:
    """driver: goes on, the next command clears the link if it must; user reads: nothing."""
    bench.model.faults.pending_clears = 100
    laser = bench.laser(profile=profile)
    assert bench.model.faults.pending_clears < 100
    laser.configure(SQUARE)
    assert laser.readback().warnings == ()


@pytest.mark.fault("error queue")
def test_error_queue_without_end(
    bench: AwgBench, profile: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """driver: reads 32 entries, or none when they are garbage, and goes on; user reads: 32 warnings at most."""  # noqa: E501
    queried = bench.model._queried
    reply = ['-350,"Queue overflow"']
    monkeypatch.setattr(
        bench.model, "_queried", lambda path: reply[0] if "ERR" in path else queried(path)
    )
    bench.laser(profile=profile).close()
    assert sum("ERR" in c for c in bench.model.commands) == 32
    bench.model.commands.clear()
    reply[0] = "<?garbage"
    laser = bench.laser(profile=profile)
    assert sum("ERR" in c for c in bench.model.commands) == 1
    laser.configure(SQUARE)


@pytest.mark.parametrize(
    ("path", "shows", "text"),
    [
        ("BASE:FREQuency", "19999", "frequency is 19999 instead of 20000"),
        ("BASE:HIGH", "3", "high is 3 instead of 5"),
        ("BASE:DUTY", "50", "duty is 50 instead of 30"),
        ("LIMit:UPPer", "10", "limit_upper is 10 instead of 5"),
        ("LIMit:ENABle", "OFF", "limit_enable is False instead of True"),
        ("INVersion", "ON", "inversion is True instead of False"),
        ("BASE:WAVe", "SINe", "waveform is SINE instead of SQUare"),
        ("MODe", "AM", "mode is AM instead of CONTinue"),
        ("AMPLitude:UNIT", "VRMS", "amplitude_unit is VRMS instead of VPP"),
        ("LOAD", "50", "load is 50 instead of 10000"),
    ],
)
@pytest.mark.fault("setting clamped or ignored")
def test_setting_ignored_or_clamped(bench: AwgBench, path: str, shows: str, text: str) -> None:
    """driver: compares with tolerance, refuses light; user reads: laser generator: frequency is 19999 instead of 20000; check its display ..."""  # noqa: E501
    bench.model.faults.changed = {path: shows}
    laser = bench.laser()
    laser.arm()
    with pytest.raises(DeviceError, match=text):
        laser.configure(Modulation(20_000.0, 0.3))
    with pytest.raises(DeviceError, match=r"not armed|not configured"):
        laser.enable()
    assert not bench.model.output


@pytest.mark.parametrize(
    ("path", "value"),
    [("BASE:HIGH", "2.5"), ("LIMit:ENABle", "OFF"), ("BASE:FREQuency", "71"), ("LOAD", "50")],
)
@pytest.mark.fault("setting clamped or ignored")
def test_panel_touched_before_light(bench: AwgBench, path: str, value: str) -> None:
    """driver: reads every setting back before it switches on, refuses; user reads: ... instead of ...; check its display ..."""  # noqa: E501
    laser = bench.ready_laser()
    assert bench.model.touch(path, value)
    with pytest.raises(DeviceError, match="instead of"):
        laser.enable()
    assert not bench.model.output


@pytest.mark.fault("setting clamped or ignored")
def test_panel_touched_while_lit(bench: AwgBench) -> None:
    """driver: notices it at the next read-back, switches off; user reads: high is 3 instead of 5; check its display ..."""  # noqa: E501
    laser = bench.lit_laser()
    assert bench.model.touch("BASE:HIGH", "3")
    with pytest.raises(DeviceError, match="high is 3 instead of 5"):
        laser.readback()
    assert not bench.model.output
    assert laser.readback().output is LaserOutput.OFF


@pytest.mark.fault("setting clamped or ignored")
def test_switched_on_at_the_panel(bench: AwgBench) -> None:
    """driver: an output that is on without a command is switched off; user reads: output found on; it was not switched on from here."""  # noqa: E501
    laser = bench.ready_laser()
    assert bench.model.touch("OUTPut", "ON")
    with pytest.raises(DeviceError, match="found on; it was not switched on from here"):
        laser.readback()
    assert not bench.model.output


@pytest.mark.fault("generator rebooted")
def test_rebooted_while_lit(bench: AwgBench) -> None:
    """driver: output reads OFF, light is refused until it is configured; user reads: output found off; restarted, or switched off by hand."""  # noqa: E501
    laser = bench.lit_laser()
    bench.model.reboot()
    assert laser.readback().output is LaserOutput.OFF
    assert "restarted" in laser.readback().reason
    laser.arm()
    with pytest.raises(DeviceError, match="not configured"):
        laser.enable()
    laser.configure(SQUARE)
    laser.arm()
    laser.enable()
    assert bench.model.lit


@pytest.mark.fault("generator rebooted")
def test_rebooted_before_light(bench: AwgBench) -> None:
    """driver: reads back before each light, finds the maker's settings, refuses; user reads: load ... instead of ..."""  # noqa: E501
    laser = bench.ready_laser()
    bench.model.reboot()
    with pytest.raises(DeviceError, match="instead of"):
        laser.enable()
    assert not bench.model.output


@pytest.mark.fault("no permission, busy")
def test_kernel_driver_and_second_program(bench: AwgBench) -> None:
    """driver: detaches usbtmc and gives it back on close; a second program is refused; user reads: in use; close the other program ..."""  # noqa: E501
    bench.model.kernel_driver = "usbtmc"
    laser = bench.laser()
    with pytest.raises(DeviceError, match="in use; close the other program"):
        bench.laser()
    laser.close()
    assert bench.model.kernel_driver == "usbtmc"


@pytest.mark.fault("no permission, busy")
def test_no_permission(bench: AwgBench) -> None:
    """driver: opens once permission is there; user reads: permission denied; install the udev rules of docs/hardware.md ..."""  # noqa: E501
    bench.model.denied = True
    with pytest.raises(DeviceError, match="permission denied; install the udev rules"):
        bench.laser()
    bench.model.denied = False
    assert bench.laser().readback().output is LaserOutput.OFF


@pytest.mark.fault("no permission, busy")
def test_no_generator_and_two(bench: AwgBench) -> None:
    """driver: refuses to choose; user reads: no such device on the bus; check cable ... / 2 devices match ...; give the serial."""  # noqa: E501
    bench.models = []
    with pytest.raises(DeviceGoneError, match="laser generator: no such device on the bus"):
        bench.laser()
    other = AwgModel(bench.clock, serial="AWG0000000002", wait=lambda *_: False)
    bench.models = [bench.model, other]
    with pytest.raises(DeviceError, match=r"2 devices match.*give the serial"):
        bench.laser()
    assert bench.laser(serial="AWG0000000002").identity.serial == "AWG0000000002"


def test_any_single_fault_on_the_way_to_light_leaves_no_unknown_light(bench: AwgBench) -> None:
    """Lit as requested, or reported as unknown."""
    faults: list[Callable[[AwgModel], object]] = [
        lambda model: model.stalled.add(ENDPOINT_IN),
        lambda model: model.stalled.add(ENDPOINT_OUT),
        lambda model: setattr(model.faults, "wrong_tags", 1),
        lambda model: setattr(model.faults, "lost_replies", 1),
        lambda model: setattr(model, "gone", True),
    ]
    outcomes = {_struck(fault, at) for at in range(60) for fault in faults}
    assert outcomes == {"lit", "unknown"}


def _struck(fault: Callable[[AwgModel], object], at: int) -> str:
    bench = AwgBench()
    laser = bench.laser()
    messages = itertools.count(1)
    execute = bench.model.bulk_out

    def bulk_out(*arguments: Any) -> int:
        if next(messages) == at:
            fault(bench.model)
        return execute(*arguments)

    bench.model.bulk_out = bulk_out  # type: ignore[method-assign]
    try:
        laser.configure(SQUARE)
        laser.arm()
        laser.enable()
    except DeviceError as error:
        unknown = "laser state unknown" in str(error)
        assert (laser.readback().output is LaserOutput.UNKNOWN) == unknown
        assert unknown or not bench.model.output
        return "unknown" if unknown else "off"
    assert bench.model.lit
    return "lit"


def test_disabled_from_many_threads_it_is_off(bench: AwgBench) -> None:
    laser = bench.lit_laser()
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda _: laser.disable(), range(8)))
    assert bench.outputs() == ["OFF", "ON", "OFF"]
