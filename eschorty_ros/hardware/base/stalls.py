"""Time in which a process did not run: stalls of this one, the state of another one."""

from __future__ import annotations

import time

LEAST_S = 0.1

_STATES = {"T": "stopped", "t": "stopped by a debugger", "Z": "dead", "X": "dead"}


class StallMeter:
    """Measures the stalls of this process by the delay of a loop's turns.

    A machine that stalls (it swaps, or is a virtual one that is not run) makes every received
    heartbeat old at once. A watchdog excludes that time, and compares ages as of ``measured_s``: a
    stall may begin after a measurement. The end of another process is noticed by other means.

    Public attributes:
    - ``measured_s``: Time of the last measurement, steady clock.
    """

    def __init__(self) -> None:
        self.measured_s = time.monotonic()

    def measure(self, period_s: float) -> float:
        """Return the seconds by which a turn of this period is late, 0 when fewer than 0.1."""
        before_s, self.measured_s = self.measured_s, time.monotonic()
        late_s = self.measured_s - before_s - period_s
        return late_s if late_s >= LEAST_S else 0.0


def process_fault(pid: int) -> str:
    """Return why process ``pid`` runs no code of its own, ``""`` while it does or is not known.

    A crash that dumps core keeps its descriptors open for as long as the dump takes.
    """
    try:
        with open(f"/proc/{pid}/status", encoding="ascii", errors="replace") as stream:
            status = stream.read()
    except (FileNotFoundError, ProcessLookupError):
        return "gone"
    except OSError:
        # Such as too many open files here, which says nothing about that process.
        return ""
    if "\nCoreDumping:\t1" in status:
        return "dumping core"
    return _STATES.get(status.partition("\nState:\t")[2][:1], "")


def process_ended(pid: int) -> bool:
    """Return whether process ``pid`` has ended, also while its parent has not waited for it."""
    return process_fault(pid) in ("gone", "dead")
