"""The client of laser, stage and reconstruction while its goal is canceled."""

from types import SimpleNamespace

import pytest

from eschorty_ros.control.instrument_monitor import InstrumentMonitor
from eschorty_ros.control.paced_waiting import PacedWaiting
from eschorty_ros.control.scan_sequence import ScanCanceled, ScanRequest
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
    """The client of a goal that is canceled while the reconstruction's answer is on its way."""

    def __init__(self):
        monitor = InstrumentMonitor(lambda: True)
        PacedWaiting.__init__(self, "scanner", monitor, lambda: 0, lambda: True, 3.0)
        self._service_timeout_s = 5.0
        answer = SimpleNamespace(success=True, message="")
        self._clients = {
            "reconstruction/begin_scan": SimpleNamespace(
                call_async=lambda request: Answered(answer, 3)
            )
        }
        PacedWaiting.prepare(self, lambda: True, lambda phase: None)


def test_a_cancel_waits_until_the_reconstruction_has_confirmed_that_it_collects():
    client = CanceledClient()
    client.begin_scan(ScanRequest("s", 20.0, 40.0, 50.0, 70.0))
    with pytest.raises(ScanCanceled):
        client.tick()
