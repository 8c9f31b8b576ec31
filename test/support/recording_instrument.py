"""An instrument that records the steps of a sequence."""

from eschorty_ros.control.calibration_sequence import run_capture
from eschorty_ros.control.scan_sequence import ScanSummary


class RecordingInstrument:
    """Records every call; the ``failing`` one, (name, number), raises ``error``."""

    def __init__(self, failing=None, error=None, summary=None):
        self._summary = summary or ScanSummary(points=5, completeness=1.0)
        self.calls = []
        self._failing = failing
        self._error = error

    def __getattr__(self, name):
        def call(*arguments):
            self.calls.append(name)
            if self._failing == (name, self.calls.count(name)):
                raise self._error
            return self._summary if name == "end_scan" else None

        return call

    def capture(self, request):
        return run_capture(self, request, self.begin, self.finish)

    def steps(self):
        return [name for name in self.calls if name not in ("report", "watch", "shield")]
