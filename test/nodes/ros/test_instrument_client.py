"""The client of laser, stage and reconstruction while its goal is canceled."""

import time
from types import SimpleNamespace

import pytest
from action_msgs.msg import GoalStatus

from eschorty_ros.control import paced_waiting
from eschorty_ros.control.instrument_monitor import InstrumentMonitor, LaserReport
from eschorty_ros.control.paced_waiting import PacedWaiting
from eschorty_ros.control.scan_sequence import ScanCanceled, ScanFailure, ScanRequest
from eschorty_ros.hardware.base.protocols import LaserOutput
from eschorty_ros.nodes.ros.instrument_client import ScanClient


class Answered:
    """A future that is done when it has been asked some times."""

    def __init__(self, answer, asked):
        self._answer, self._asked = answer, asked

    def done(self):
        self._asked -= 1
        return self._asked < 0

    def result(self):
        return self._answer


class CanceledClient(ScanClient):
    """The client of a goal that is canceled while the reconstruction's answer is on its way.

    - ``answers``: Those of the reconstruction; one that begins the scan when omitted.
    """

    def __init__(self, *answers, canceled=True):
        answers = list(answers) or [SimpleNamespace(success=True, message="", recording="")]
        monitor = InstrumentMonitor(lambda: True)
        PacedWaiting.__init__(self, "scanner", monitor, lambda: 0, lambda: True, 3.0)
        self._service_timeout_s = 5.0
        self._modulation = 0.0, 0.0
        self._clients = {
            "reconstruction/begin_scan": SimpleNamespace(
                call_async=lambda request: Answered(answers.pop(0), 3)
            )
        }
        PacedWaiting.prepare(self, lambda: canceled, lambda phase: None)


def test_a_cancel_waits_until_the_reconstruction_has_confirmed_that_it_collects():
    client = CanceledClient()
    client.begin_scan(ScanRequest("s", 20.0, 40.0, 50.0, 70.0))
    with pytest.raises(ScanCanceled):
        client.tick()


@pytest.mark.parametrize("retry", [True, False])
def test_a_scan_that_is_refused_begins_later_if_the_reason_may_pass(monkeypatch, retry):
    refused = SimpleNamespace(success=False, message="odom has 2 publishers", retry=retry)
    taken = SimpleNamespace(success=True, message="", recording="")
    client = CanceledClient(refused, refused, taken, canceled=False)
    request = ScanRequest("s", 20.0, 40.0, 50.0, 70.0)
    if retry:
        monkeypatch.setattr(paced_waiting, "_NOTED_S", 0.0)
        waits = set()
        client._feedback = lambda phase: waits.add(client.waits_for)
        client.begin_scan(request)
        assert "reconstruction: odom has 2 publishers" in waits
    else:
        with pytest.raises(ScanFailure, match="has 2 publishers"):
            client.begin_scan(request)


def test_a_scan_left_open_that_ends_meanwhile_does_not_fail_the_next():
    client = CanceledClient(canceled=False)
    client._node = SimpleNamespace(get_logger=lambda: SimpleNamespace(warning=lambda _: None))
    client.monitor.reconstruction = SimpleNamespace(scan_id="open")
    ended = SimpleNamespace(success=False, message="scan 'open' is not being collected")
    client._clients["reconstruction/end_scan"] = SimpleNamespace(
        call_async=lambda request: Answered(ended, 3)
    )
    client.begin_scan(ScanRequest("s", 20.0, 40.0, 50.0, 70.0))


def test_a_refusal_of_the_stage_names_it_once():
    client = CanceledClient(canceled=False)
    result = SimpleNamespace(success=False, message="stage refused: node is inactive")
    ended = Answered(SimpleNamespace(status=GoalStatus.STATUS_ABORTED, result=result), 1)
    handle = SimpleNamespace(accepted=True, get_result_async=lambda: ended)
    client._stage = SimpleNamespace(send_goal_async=lambda goal: Answered(handle, 0))
    client.monitor.update_stage(1, 10.0, 0.0, 0.0)
    with pytest.raises(ScanFailure, match=r"^stage: refused: node is inactive$"):
        client.move(10.0, 5.0)


def test_a_stall_of_the_scanner_in_a_move_is_not_taken_for_one_of_the_stage(monkeypatch):
    client = CanceledClient(canceled=False)
    never = SimpleNamespace(done=lambda: False)
    handle = SimpleNamespace(accepted=True, get_result_async=lambda: never)
    client._stage = SimpleNamespace(send_goal_async=lambda goal: Answered(handle, 0))
    client.monitor.update_stage(1, 10.0, 0.0, 0.0)

    def stalled(duration_s):
        now_s = time.monotonic()
        monkeypatch.setattr(time, "monotonic", lambda: now_s + 6.0)

    monkeypatch.setattr(time, "sleep", stalled)
    with pytest.raises(ScanFailure, match=r"scanner: its process did not run for 6\.0 s"):
        client.move(10.0, 5.0)


def test_a_clock_that_seems_to_be_of_another_time_is_named_in_the_feedback():
    client, waits = CanceledClient(canceled=False), []
    client._states, client._node_timeout_s, client._needed = {}, 5.0, lambda begun_ns: []
    client.monitor.update_stage(1, 10.0, 0.0, 0.9)

    def later(phase):
        waits.append(client.waits_for)
        client.monitor.update_stage(2, 10.0, 0.0, 0.01)

    client._feedback = later
    client.check_nodes()
    assert len(waits) == 1
    assert waits[0].startswith("stage: its stamps are 0.900 s behind")
    assert client.waits_for == ""


def test_a_laser_that_waits_for_a_heartbeat_is_named_in_the_feedback():
    reason = "laser refused: camera/heartbeat reports stopped; look at the camera node"
    client, refusals, waits = CanceledClient(canceled=False), [reason, reason, ""], []
    client._heartbeat = SimpleNamespace(begin=lambda: None, healthy=True)
    client._arm_and_enable = lambda: refusals.pop(0)
    client.monitor.update_laser(LaserReport(LaserOutput.ON, 70.0, 0.5, ""), 0.0)
    client._feedback = lambda phase: waits.append(client.waits_for)
    client.laser_on()
    assert set(waits) == {"", reason}
    assert client.waits_for == ""


@pytest.mark.parametrize(
    ("other", "words"),
    [
        ((50.0, 0.3), "frequency reads back 50 Hz, requested 70 Hz"),
        ((70.0, 0.9), "duty reads back 0.9, requested 0.3"),
    ],
)
@pytest.mark.parametrize("set_at", ["before", "laser/arm", "laser/enable"])
def test_a_modulation_that_another_program_sets_ends_the_sequence(other, words, set_at):
    """Before there is light where it is known by then."""
    client, calls = CanceledClient(canceled=False), []
    taken = SimpleNamespace(results=[SimpleNamespace(successful=True)] * 2)
    client._clients["laser/set_parameters"] = SimpleNamespace(
        call_async=lambda request: Answered(taken, 1)
    )

    def report(output, modulation):
        client.monitor.update_laser(LaserReport(output, *modulation, ""), 0.0)

    def answer(name, output):
        calls.append(name)
        report(output, other if name == set_at else (70.0, 0.3))
        return Answered(SimpleNamespace(success=True), 1)

    for name, output in (("laser/arm", LaserOutput.OFF), ("laser/enable", LaserOutput.ON)):
        client._clients[name] = SimpleNamespace(
            call_async=lambda request, name=name, output=output: answer(name, output)
        )
    report(LaserOutput.OFF, (70.0, 0.3))
    client.configure_laser(70.0, 0.3)
    client._heartbeat = SimpleNamespace(begin=lambda: None, healthy=True)
    if set_at == "before":
        report(LaserOutput.OFF, other)
    with pytest.raises(ScanFailure, match=f"^laser: {words}; another program has set it"):
        client.laser_on()
    assert ("laser/enable" in calls) == (set_at == "laser/enable")
