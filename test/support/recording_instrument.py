"""An instrument that records the steps of a sequence."""

from eschorty_ros.control.calibration_sequence import run_capture
from eschorty_ros.control.scan_sequence import MoveLimits, ScanSummary

LIMITS = MoveLimits((0.0, 220.0), 250.0, 2000.0)
FOLDER = "/data/of scan"


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
            answers = {"begin_scan": FOLDER, "end_scan": self._summary, "stage_limits": LIMITS}
            return answers.get(name)

        return call

    def capture(self, request):
        return run_capture(self, request, self.begin, self.finish)

    def steps(self):
        return [name for name in self.calls if name not in ("report", "watch", "shield")]
