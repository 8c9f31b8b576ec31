"""Light as a burst of counted cycles: it ends by itself unless it is renewed."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest
from awg_bench import AwgBench

from eschorty_ros.core.base.errors import ArgumentError, DeviceError
from eschorty_ros.core.base.files import config_folders
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.hardware.base.protocols import LaserOutput
from eschorty_ros.hardware.laser import awg
from eschorty_ros.hardware.laser.awg import UNBOUNDED, AwgLaser

GRANT_NS = 450_000_000


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> AwgBench:
    """A generator whose bursts run by the clock that the tests set, as the driver's clock does."""
    made = AwgBench(tmp_path / "log")
    steady = SimpleNamespace(monotonic=lambda: (made.clock.now_ns - 10**18) * 1e-9)
    monkeypatch.setattr(awg, "time", steady)
    return made


def passes(bench: AwgBench, ns: int) -> bool:
    """Let the time pass; return whether the output is lit then."""
    bench.clock.now_ns += ns
    bench.model.end_burst()
    return bench.model.lit


def while_running(folder: Path, what: str) -> str:
    """Return the path of the profile with another effect of triggers."""
    text = next(f / "awg_utg900e.yaml" for f in config_folders() if f.is_dir()).read_text()
    path = folder / "profile.yaml"
    path.write_text(text.replace("while_running: extends", f"while_running: {what}"))
    return str(path)


@pytest.mark.parametrize(
    "modulation",
    [
        Modulation(16.0),
        Modulation(70.0),
        Modulation(70.0, 0.9, "pulse"),
        Modulation(1234.5, 0.01, "square"),
        Modulation(20e3, 0.5, "sine"),
    ],
    ids=str,
)
def test_light_ends_by_itself_after_one_grant(bench: AwgBench, modulation: Modulation) -> None:
    laser = bench.laser()
    laser.configure(modulation)
    laser.arm()
    laser.enable()
    least_ns = round(GRANT_NS - 1.001e9 / modulation.frequency_hz)
    assert passes(bench, least_ns)
    # The output is still on; the level between bursts is dark.
    assert not passes(bench, GRANT_NS - least_ns + 1)
    assert bench.model.output
    assert bench.outputs() == ["OFF", "ON", "OFF"]


def test_renewed_light_goes_on_with_its_phase_and_a_late_renewal_is_a_pause(
    bench: AwgBench,
) -> None:
    laser = bench.lit_laser()
    changes: list[int] = []
    bench.model.on_change = lambda since_ns, *_: changes.append(since_ns)
    began_ns = laser.readback().output_since_ns
    for _ in range(50):
        assert passes(bench, round(laser.renew() * 1e9))
    state = laser.readback()
    assert (state.output_since_ns, state.counters["light_pauses"]) == (began_ns, 0)
    assert state.counters["light_grants"] >= 50
    assert changes == []
    assert not passes(bench, GRANT_NS + 7)
    laser.renew()
    assert bench.model.lit
    state = laser.readback()
    assert (state.output_since_ns, state.counters["light_pauses"]) == (bench.clock.now_ns, 1)
    assert changes[-1] == bench.clock.now_ns
    assert any("light paused" in warning for warning in state.warnings)
    laser.disable()
    assert not bench.model.output
    laser.renew()
    assert not bench.model.output


def test_renewal_overtakes_a_read_back(bench: AwgBench, monkeypatch: pytest.MonkeyPatch) -> None:
    laser = bench.lit_laser()
    queried = bench.model._queried

    def slowly(path: str) -> str | None:
        # Longer than a grant in all; the guard's thread asks for renewals all the time.
        passes(bench, GRANT_NS // 4)
        assert renewing.submit(laser.renew).result() < 0.1
        return queried(path)

    monkeypatch.setattr(bench.model, "_queried", slowly)
    with ThreadPoolExecutor(1) as renewing:
        state = laser.readback()
    assert bench.model.lit
    assert (state.output, state.counters["light_pauses"]) == (LaserOutput.ON, 0)


@pytest.mark.parametrize("what", ["restarts", "ignored"])
def test_every_change_of_phase_is_reported(bench: AwgBench, tmp_path: Path, what: str) -> None:
    bench.model.burst_trigger = what
    laser = bench.lit_laser(profile=while_running(tmp_path, what))
    phases = [bench.clock.now_ns]
    bench.model.on_change = lambda since_ns, lit, _: phases.append(since_ns) if lit else None
    for _ in range(20):
        passes(bench, round(laser.renew() * 1e9))
        assert laser.readback().output_since_ns == phases[-1]
    assert len(phases) > 5


def test_triggers_that_the_generator_ignores_bound_the_light_all_the_same(bench: AwgBench) -> None:
    bench.model.burst_trigger = "ignored"
    laser = bench.lit_laser()
    assert passes(bench, GRANT_NS // 2)
    laser.renew()
    assert not passes(bench, GRANT_NS // 2 + 1)


@pytest.mark.parametrize("how", ["no burst", "cycles not taken", "no replies", "not wanted"])
def test_light_that_does_not_end_by_itself_is_reported(bench: AwgBench, how: str) -> None:
    settings: dict[str, object] = {}
    if how == "no burst":
        bench.model.burst_trigger = ""
    elif how == "cycles not taken":
        bench.model.faults.ignored.add("BURSt:CYCLes")
    elif how == "no replies":
        settings["readback"] = "off"
    else:
        settings["light_grant"] = 0.0
    laser = bench.lit_laser(**settings)
    assert passes(bench, 10 * GRANT_NS)
    state = laser.readback()
    assert UNBOUNDED in state.warnings
    assert (state.output, state.counters["light_grant_s"]) == (LaserOutput.ON, 0.0)
    assert bench.model.channels[0].mode == "CONTINUE"


def test_panel_that_makes_the_light_continuous_is_noticed(bench: AwgBench) -> None:
    laser = bench.lit_laser()
    bench.model.touch("MODe", "CONTinue")
    with pytest.raises(DeviceError, match="mode is CONTINUE"):
        laser.readback()
    assert not bench.model.output


def test_renewal_that_fails_switches_off(bench: AwgBench, monkeypatch: pytest.MonkeyPatch) -> None:
    laser: AwgLaser = bench.lit_laser()

    def refuse() -> None:
        raise DeviceError("broken")

    monkeypatch.setattr(laser._channel, "trigger", refuse)
    with pytest.raises(DeviceError, match="broken"):
        laser.renew()
    assert not bench.model.output


def test_grants_too_short_or_too_long_are_refused(bench: AwgBench) -> None:
    for light_grant in (0.1, 0.6):
        with pytest.raises(ArgumentError, match="light_grant"):
            bench.settings(light_grant=light_grant)
