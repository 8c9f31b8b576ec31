"""Fault plans: what a file may say, and that it happens to the models when it says."""

import copy
import errno
import struct
from types import SimpleNamespace

import pytest
import usb.core
from usb_loop import IN, OUT, Loop

from eschorty_ros.core.errors import FormatError
from eschorty_ros.emulation.apt_model import AptModel
from eschorty_ros.emulation.awg_model import AwgModel
from eschorty_ros.emulation.evk4_model import Evk4Model
from eschorty_ros.emulation.fault_catalogue import CATALOGUE, Dose
from eschorty_ros.emulation.faults import FaultPlan, FaultScript, load_fault_plan
from eschorty_ros.emulation.usb_backend import EmulatedBackend


def planned(tmp_path, text):
    path = tmp_path / "plan.yaml"
    path.write_text(text)
    return load_fault_plan(path)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("faults: [{device: camera, fault: unplug, at: {after_s: 1}, tmie: 2}]", "tmie"),
        ("faults: [{device: camera, fault: unplgu, at: {after_s: 1}}]", "choose one of unplug"),
        ("faults: [{device: lamp, fault: unplug, at: {after_s: 1}}]", "device"),
        ("faults: [{device: camera, fault: unplug, at: {}}]", "exactly one of after_s"),
        (
            "faults: [{device: camera, fault: unplug, at: {after_s: 1, after_bytes: 2}}]",
            "exactly one of after_s",
        ),
        ("faults: [{device: camera, fault: unplug, at: {after_s: -1}}]", "after_s is -1"),
        ("faults: [{device: camera, fault: unplug, at: {after_s: soon}}]", "after_s is 'soon'"),
        ("faults: [{device: laser, fault: ignored, at: {after_s: 1}}]", "needs a target"),
        (
            "faults: [{device: laser, fault: wrong_tags, for_s: 1, at: {after_s: 1}}]",
            "ends by itself",
        ),
        ("faults: [{device: stage, fault: mute, at: {on_message: move}}]", "hexadecimal"),
        ("faults: [{device: stage, fault: garbage, amount: 0, at: {after_s: 1}}]", "amount is 0"),
        ("fault: []", "did you mean faults"),
        ("- a", "instead of keys"),
    ],
)
def test_a_plan_that_cannot_be_followed_is_refused_in_one_line(tmp_path, text, says):
    with pytest.raises(FormatError) as caught:
        planned(tmp_path, text)
    assert says in str(caught.value)
    assert "plan.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)


class Clock:
    ns = 0

    def __call__(self):
        return self.ns


def scripted(tmp_path, text, device="laser"):
    """A loop-back device in the laser's place: its OUT endpoint serves as the laser's."""
    loop, clock = Loop(), Clock()
    plan = planned(tmp_path, text)
    script = FaultScript(plan, {device: loop}, clock)
    return script, loop, clock, usb.core.find(backend=EmulatedBackend(lambda: [loop]))


def code_of(transfer):
    with pytest.raises(usb.core.USBError) as caught:
        transfer()
    return caught.value.errno


def test_a_fault_begins_and_ends_by_the_clock(tmp_path):
    script, _, clock, device = scripted(
        tmp_path, "faults: [{device: laser, fault: mute, at: {after_s: 2}, for_s: 0.5}]"
    )
    clock.ns = 1_999_999_999
    script.step("laser")
    assert device.write(OUT, b"x") == 1
    clock.ns = 2_000_000_000
    script.step("laser")
    assert code_of(lambda: device.write(OUT, b"x")) == errno.ETIMEDOUT
    clock.ns = 2_500_000_000
    script.step("laser")
    assert device.write(OUT, b"x") == 1
    assert [(t, fault.fault) for t, fault in script.begun] == [(2_000_000_000, "mute")]


@pytest.mark.parametrize("at", ["{after_transfers: 3}", "{after_bytes: 10}"])
def test_a_fault_begins_by_the_traffic(tmp_path, at):
    _, loop, _, device = scripted(tmp_path, f"faults: [{{device: laser, fault: unplug, at: {at}}}]")
    device.write(OUT, b"1234")
    device.read(IN, 64)
    device.write(OUT, b"12")
    assert code_of(lambda: device.read(IN, 64)) == errno.ENODEV
    assert loop.gone


def test_a_fault_begins_right_after_a_message(tmp_path):
    _, _, _, device = scripted(
        tmp_path, "faults: [{device: laser, fault: mute, at: {on_message: ':chan1:outp'}}]"
    )
    device.write(OUT, b"*IDN?")
    device.read(IN, 64)
    device.write(OUT, b":CHAN1:OUTPut ON")
    assert code_of(lambda: device.read(IN, 64)) == errno.ETIMEDOUT


def test_unplugging_ends_with_a_device_at_another_address(tmp_path):
    script, loop, clock, device = scripted(
        tmp_path, "faults: [{device: laser, fault: unplug, at: {after_transfers: 1}, for_s: 1}]"
    )
    before = loop.address
    device.write(OUT, b"x")
    assert loop.gone
    clock.ns = 1_000_000_000
    script.step("laser")
    assert not loop.gone
    assert loop.address != before


def test_registers_of_the_camera_are_messages():
    camera = SimpleNamespace(mute=False, on_transfer=None)
    at = {"on_message": "2C"}
    plan = FaultPlan.model_validate({"faults": [{"device": "camera", "fault": "mute", "at": at}]})
    FaultScript(plan, {"camera": camera}, lambda: 0)
    camera.on_transfer(0x02, struct.pack("<5I", 0x40010102, 12, 0, 0x28, 0x2C))
    camera.on_transfer(0x02, struct.pack("<5I", 0x10102, 12, 0, 0x2C, 1))
    assert not camera.mute
    camera.on_transfer(0x02, struct.pack("<5I", 0x40010102, 12, 0, 0x2C, 1))
    assert camera.mute


class Line:
    """A serial model that answers with what it got."""

    def __init__(self):
        self.mute = self.gone = False
        self.waiting = b""

    def feed(self, data):
        self.waiting += data

    def step(self):
        data, self.waiting = self.waiting, b""
        return b"" if self.mute else data


def test_the_stage_is_served_through_the_script():
    line = Line()
    at = {"on_message": "0453"}
    plan = FaultPlan.model_validate(
        {"faults": [{"device": "stage", "fault": "mute", "at": at, "for_s": 1.0}]}
    )
    clock = Clock()
    served = FaultScript(plan, {"stage": line}, clock).line()
    move = struct.pack("<HHBBHi", 0x0453, 6, 0xD0, 1, 1, 0x0448)
    status = struct.pack("<HBBBB", 0x0480, 1, 0, 0x50, 1)
    served.feed(status)
    assert served.step() == status
    served.feed(status + move)
    assert served.step() == b""
    assert line.mute
    clock.ns = 1_000_000_000
    served.step()
    assert not line.mute


def test_a_stage_that_is_gone_comes_back_although_nobody_serves_it():
    line, clock = Line(), Clock()
    at = {"after_s": 0.0}
    plan = FaultPlan.model_validate(
        {"faults": [{"device": "stage", "fault": "unplug", "at": at, "for_s": 1.0}]}
    )
    served = FaultScript(plan, {"stage": line}, clock).line()
    served.step()
    assert served.gone
    clock.ns = 1_000_000_000
    assert not served.gone


def test_the_catalogue_says_what_its_faults_do():
    for kinds in CATALOGUE.values():
        for name, kind in kinds.items():
            assert kind.means, name
            assert kind.id[0] in "USX", name
    assert Dose().amount == 1


@pytest.mark.parametrize(
    ("device", "name"), [(device, name) for device, kinds in CATALOGUE.items() for name in kinds]
)
def test_every_fault_begins_and_ends_on_the_model_of_its_device(device, name):
    model, before = fresh(device)
    kind = CATALOGUE[device][name]
    kind.begin(model, Dose(3, TARGETS.get(name, "moved"), now_ns=0))
    if kind.end:
        assert switches(model) != before
        kind.end(model, Dose(3, TARGETS.get(name, "moved"), now_ns=0))
        assert switches(model) == before


TARGETS = {"changed": "BASE:FREQuency=19999", "ignored": "BASE:FREQuency", "touched": "OUTPut=ON"}


def fresh(device):
    models = {
        "camera": lambda: Evk4Model(Silence()),
        "laser": lambda: AwgModel(lambda: 0),
        "stage": lambda: AptModel(lambda: 0),
    }
    model = models[device]()
    return model, switches(model)


def switches(model):
    """Public state that faults work on; the address alone changes for good."""
    parts = (model, *(getattr(model, n, None) for n in ("faults", "answer_faults", "axis")))
    values = {}
    for part in parts:
        values |= {
            f"{type(part).__name__}.{name}": copy.copy(value)
            for name, value in getattr(part, "__dict__", {}).items()
            if isinstance(value, (bool, int, str, set, dict, type(None)))
            and name.lstrip("_") == name
            and name not in ("address", "on_transfer")
        }
    return values | {"gone": model.gone}


class Silence:
    def start(self):
        pass

    def stop(self):
        pass

    def read(self, max_bytes, timeout_s):
        return b""
