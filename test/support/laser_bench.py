"""The laser node with its real driver and guard on an emulated generator, each a process."""

import contextlib
import time
from pathlib import Path
from typing import Any

from awg_process import awg_process
from contact import Contact
from eschorty_ros.msg import LaserState
from ros_process import NodeProcess, Observer, stamped_after, wait_until
from std_srvs.srv import SetBool, Trigger

from eschorty_ros.nodes.ros import qos

OFF_LIMIT_S = 0.25
"""Longest time from a fault until the generator's log has the output off."""


class LaserBench:
    """Generator, laser node and what they publish; ``stack`` ends the processes."""

    def __init__(
        self,
        stack: contextlib.ExitStack,
        folder: Path,
        module: str = "eschorty_ros.nodes.laser.node",
        **parameters: Any,
    ) -> None:
        self._stack = stack
        self.observer = observer = stack.enter_context(Observer())
        self.awg = stack.enter_context(awg_process(folder))
        # No report of the contact that a loaded machine delays may end the light.
        defaults = {"driver": "awg", "backend": self.awg.backend, "interlock_timeout": 60.0}
        self._node = module, {**defaults, **parameters}
        self.node = self.start(*self._node)
        self.states = observer.collect(LaserState, "laser/state", qos.latched(qos.STATE_HISTORY))
        self.contact = Contact(observer)

    def start(self, module: str, parameters: dict[str, Any]) -> NodeProcess:
        """Start another process of this bench, whose output is printed at its end."""
        process = NodeProcess(module, parameters, domain=self.observer.domain)
        self._stack.enter_context(process)
        self._stack.callback(lambda: print(f"--- {process.module}\n{process.output}"))
        return process

    def restart(self) -> None:
        """End the laser node, if it runs, and start another one."""
        self.node.kill()
        self.node = self.start(*self._node)
        self.observer.wait_for_state("laser", "active")

    def arm(self) -> Any:
        return self.observer.call(Trigger, "laser/arm")

    def enable(self, on: bool = True) -> Any:
        return self.observer.call(SetBool, "laser/enable", SetBool.Request(data=on))

    def wait_for_state(self, output: int) -> None:
        """Wait for a state from after now: this output, requested so, and a closed interlock."""
        now_ns = time.time_ns()

        def published() -> bool:
            newest = self.states[-1:]
            return stamped_after(newest, now_ns) and (
                newest[0].requested == newest[0].output == output and not newest[0].interlock_open
            )

        wait_until(published, f"output {output} in laser/state")

    def wait_for_reason(self, text: str) -> None:
        wait_until(lambda: text in self.states[-1].reason, f"{text!r} in laser/state")
