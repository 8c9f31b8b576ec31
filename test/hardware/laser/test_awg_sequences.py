"""Any sequence of calls and faults: an output that is on is never reported as off."""

from typing import Any

from awg_bench import AwgBench
from hypothesis import given, settings
from hypothesis import strategies as st

from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.emulation.awg.faults import AwgFaults
from eschorty_ros.emulation.awg.model import ENDPOINT_IN, ENDPOINT_OUT
from eschorty_ros.hardware.base.protocols import LaserOutput
from eschorty_ros.hardware.laser.awg import AwgLaser

CALLS = ("configure 70", "configure 1000", "arm", "enable", "renew", "disable", "readback")
FAULTS = {
    "stall in": lambda model: model.stalled.add(ENDPOINT_IN),
    "stall out": lambda model: model.stalled.add(ENDPOINT_OUT),
    "lost reply": lambda model: setattr(model.faults, "lost_replies", 1),
    "three lost replies": lambda model: setattr(model.faults, "lost_replies", 3),
    "late reply": lambda model: setattr(model.faults, "late_replies", 1),
    "wrong tag": lambda model: setattr(model.faults, "wrong_tags", 1),
    "mute": lambda model: setattr(model, "mute", True),
    "speaks": lambda model: setattr(model, "mute", False),
    "reboot": lambda model: model.reboot(),
    "panel": lambda model: model.touch("BASE:HIGH", "3"),
    "panel off": lambda model: model.touch("OUTPut", "OFF"),
}


def call(laser: AwgLaser, name: str) -> None:
    verb, _, value = name.partition(" ")
    arguments: list[Any] = [Modulation(float(value))] if value else []
    getattr(laser, verb)(*arguments)


def attempt(laser: AwgLaser, name: str) -> str:
    """Make a call; returns the error it was refused with, if it was."""
    try:
        call(laser, name)
    except DeviceError as error:
        return str(error)
    return ""


@settings(max_examples=200, deadline=None)
@given(st.lists(st.sampled_from(CALLS + tuple(FAULTS)), max_size=25))
def test_output_that_is_on_is_never_reported_as_off(steps: list[str]) -> None:
    bench = AwgBench()
    laser = bench.laser()
    for step in steps:
        if step in FAULTS:
            FAULTS[step](bench.model)
            continue
        refused = attempt(laser, step)
        assert "\n" not in refused
        if not refused:
            assert not (step == "disable" and bench.model.output)
            assert not (step == "enable" and not bench.model.lit)
        if bench.model.output:
            assert laser._output is not LaserOutput.OFF
        assert not bench.model.locked or bench.model.mute
    # Without faults again.
    bench.model.mute = False
    bench.model.faults = AwgFaults()
    laser.disable()
    assert not bench.model.output
    for step in ("configure 70", "arm", "enable"):
        call(laser, step)
    assert bench.model.lit
    laser.close()
    assert not bench.model.lit
    assert not bench.model.locked


@settings(max_examples=100, deadline=None)
@given(st.lists(st.sampled_from(CALLS), max_size=25))
def test_without_faults_only_arming_and_configuring_are_required(steps: list[str]) -> None:
    bench = AwgBench()
    laser = bench.laser()
    ready = armed = False
    for step in steps:
        refused = attempt(laser, step)
        ready = ready or step.startswith("configure")
        assert bool(refused) == (step == "enable" and not (armed and ready))
        armed = step == "arm" or (armed and (step not in ("enable", "disable") or bool(refused)))
        assert (laser.readback().output is LaserOutput.ON) == bench.model.lit
