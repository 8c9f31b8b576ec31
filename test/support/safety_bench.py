"""A laser node that can be broken, with the processes that send it heartbeats."""

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from eschorty_ros.msg import LaserState
from laser_bench import OFF_LIMIT_S, LaserBench
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from ros_process import NodeProcess, wait_until
from std_msgs.msg import String

from eschorty_ros.nodes.ros import qos

_GUARD = "eschorty_ros.hardware.laser_guard.guard"
SENDERS = ("laser", "camera", "stage")
WAYS_TO_ACTIVE = {"unconfigured": "configure", "inactive": "activate"}
# Every fault here has to be noticed at once, without a timeout; and no timeout may end the light
# when a loaded machine delays the senders.
TIMEOUTS = {f"{name}_timeout": 60.0 for name in ("heartbeat", "camera", "stage")}


class SafetyBench(LaserBench):
    """Generator, laser node and senders, each a process; ``stack`` ends them."""

    def __init__(
        self, stack: contextlib.ExitStack, folder: Path, senders: tuple[str, ...], **parameters: Any
    ) -> None:
        super().__init__(stack, folder, "breakable_laser", **TIMEOUTS, **parameters)
        self._names = senders
        self.senders: dict[str, NodeProcess] = {}
        self.start_senders()
        self.diagnostics = self.observer.collect(DiagnosticArray, "/diagnostics", qos.stream(100))
        self.breaking = self.observer.publisher(String, "test/break", qos.stream(10))

    def start_senders(self) -> None:
        for name in self._names:
            if name not in self.senders:
                topics = " ".join(f"{word}/heartbeat" for word in name.split())
                self.senders[name] = self.start("heartbeat_sender", {"topics": topics})

    def lose(self, name: str, number: int) -> int:
        """Send a signal to a sender, which does not count as running any more; its time."""
        sent_ns = time.monotonic_ns()
        self.senders.pop(name).send(number)
        return sent_ns

    def light(self) -> None:
        """Switch on, from any state of the node and of the senders."""
        self.start_senders()

        def lit() -> bool:
            state = self.observer.lifecycle_state("laser")
            if state in WAYS_TO_ACTIVE:
                # A guard that is about to end may still hold the generator.
                self.observer.change_state("laser", WAYS_TO_ACTIVE[state])
            if state != "active":
                return False
            answers = self.arm(), self.enable()
            print("light:", *(answer.message for answer in answers))
            if not all(answer.success for answer in answers):
                return False
            self.wait_for_state(LaserState.OUTPUT_ON)
            # The lease of a sender that was killed before may expire now.
            time.sleep(0.3)
            return self.awg.lit()

        wait_until(lit, "light", poll_s=0.2)

    def change(self, label: str) -> int:
        """Request a lifecycle transition of the laser node; the time of the request."""
        client = self.observer.node.create_client(ChangeState, "laser/change_state")
        wait_until(client.service_is_ready, "the laser's change_state")
        self.observer.wait_for_answers("laser")
        request = ChangeState.Request(transition=Transition(label=label))
        sent_ns = time.monotonic_ns()
        client.call_async(request)
        return sent_ns

    def check_off(self, cause: str, since_ns: int) -> None:
        took_s = self.awg.off_after_s(since_ns)
        print(f"{cause}: off after {took_s * 1e3:.1f} ms")
        assert 0.0 < took_s < OFF_LIMIT_S


@contextlib.contextmanager
def running(
    folder: Path, senders: tuple[str, ...] = (" ".join(SENDERS),), **parameters: Any
) -> Iterator[SafetyBench]:
    with contextlib.ExitStack() as stack:
        yield SafetyBench(stack, folder, senders, **parameters)


def guard_of(pid: int) -> int:
    """Return the process id of the guard that any thread of ``pid`` has started."""
    for task in Path(f"/proc/{pid}/task").iterdir():
        # A thread or a child may end meanwhile.
        with contextlib.suppress(OSError):
            for number in (task / "children").read_text().split():
                if _GUARD in Path(f"/proc/{number}/cmdline").read_text():
                    return int(number)
    raise AssertionError("no process of a guard")
