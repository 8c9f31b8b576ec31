"""Time from a fault to the end of light on the emulated generator's own log, as a table.

A busy process runs on each core (--busy). Every fault is repeated; median and worst are printed.

Usage: python benchmark/laser_off.py [FAULT...]
"""

import argparse
import contextlib
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from std_msgs.msg import String

sys.path.append(str(Path(__file__).parents[1] / "test" / "support"))

from safety_bench import SENDERS, SafetyBench, guard_of, running

Fault = Callable[[SafetyBench], int]


def node(number: int) -> Fault:
    """Return a fault: a signal to the laser node."""
    return lambda bench: sent(number, bench.node.pid)


def guard(number: int) -> Fault:
    """Return a fault: a signal to the guard."""
    return lambda bench: sent(number, guard_of(bench.node.pid))


def together(number: int) -> Fault:
    """Return a fault: a signal to guard and laser node within 1 ms."""
    return lambda bench: sent(number, guard_of(bench.node.pid), bench.node.pid)


def group(number: int) -> Fault:
    """Return a fault: a signal to every process of the instrument, as to a container's."""

    def end(bench: SafetyBench) -> int:
        pids = [sender.pid for sender in bench.senders.values()]
        bench.senders.clear()
        return sent(number, *pids, guard_of(bench.node.pid), bench.node.pid)

    return end


def stopped_guard_killed_node(bench: SafetyBench) -> int:
    """Stop the guard, kill the laser node."""
    guard_pid = guard_of(bench.node.pid)
    since_ns = sent(signal.SIGSTOP, guard_pid)
    sent(signal.SIGKILL, bench.node.pid)
    return since_ns


def sender(name: str, number: int) -> Fault:
    """Return a fault: a signal to the sender of a heartbeat."""
    return lambda bench: bench.lose(name, number)


def exception(bench: SafetyBench) -> int:
    """Raise an exception in a callback of the laser node."""
    since_ns = time.monotonic_ns()
    bench.breaking.publish(String(data="exception"))
    return since_ns


def transition(label: str) -> Fault:
    """Return a fault: a lifecycle transition of the lit laser node."""
    return lambda bench: bench.change(label)


def sent(number: int, *pids: int) -> int:
    """Send a signal; return the time before it."""
    since_ns = time.monotonic_ns()
    for pid in pids:
        os.kill(pid, number)
    return since_ns


SURVIVED: dict[str, Fault] = {
    **{f"{name} SIGKILL": sender(name, signal.SIGKILL) for name in SENDERS},
    **{f"{name} SIGSTOP": sender(name, signal.SIGSTOP) for name in SENDERS},
    "guard SIGKILL": guard(signal.SIGKILL),
    "guard SIGSTOP": guard(signal.SIGSTOP),
    "deactivate": transition("deactivate"),
}
FATAL: dict[str, Fault] = {
    "node SIGKILL": node(signal.SIGKILL),
    "node SIGSTOP": node(signal.SIGSTOP),
    "node SIGTERM": node(signal.SIGTERM),
    "node exception": exception,
    "node shutdown": transition("shutdown"),
    "guard and node SIGKILL": together(signal.SIGKILL),
    "guard SIGSTOP, node SIGKILL": stopped_guard_killed_node,
    "guard and node SIGSTOP": together(signal.SIGSTOP),
    "all processes SIGKILL": group(signal.SIGKILL),
}


@contextlib.contextmanager
def load(busy: int):
    """Run busy processes inside the context."""
    processes = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(busy)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def main() -> None:
    """Print one line per fault."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="faults to measure, by default all")
    parser.add_argument("--repetitions", type=int, default=20)
    parser.add_argument("--busy", type=int, default=os.cpu_count())
    options = parser.parse_args()
    chosen = {
        name: fault
        for name, fault in (SURVIVED | FATAL).items()
        if not options.names or name in options.names
    }
    with load(options.busy), contextlib.redirect_stdout(None), contextlib.ExitStack() as shared:
        bench = None
        for name, fault in chosen.items():
            taken_s = []
            for _ in range(options.repetitions):
                if name in FATAL:
                    with running(Path(tempfile.mkdtemp())) as doomed:
                        taken_s.append(measured(fault, doomed))
                else:
                    bench = bench or shared.enter_context(
                        running(Path(tempfile.mkdtemp()), SENDERS)
                    )
                    taken_s.append(measured(fault, bench))
                show(name, taken_s)


def measured(fault: Fault, bench: SafetyBench) -> float:
    """Return the time from a fault to the end of light, s."""
    bench.light()
    guard_pid = guard_of(bench.node.pid)
    taken_s = bench.awg.off_after_s(fault(bench))
    if fault in FATAL.values():
        # Also one that is stopped.
        for pid in (guard_pid, bench.node.pid):
            with contextlib.suppress(OSError):
                os.kill(pid, signal.SIGKILL)
    return taken_s


def show(name: str, taken_s: list[float]) -> None:
    """Print median and worst of one fault so far, ms; the last line of a name counts."""
    median, worst = statistics.median(taken_s) * 1e3, max(taken_s) * 1e3
    line = f"| {name} | {len(taken_s)} | {median:.0f} | {worst:.0f} |"
    print(line, file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
