"""Running nodes from ``init`` to a clean exit; on every path the hardware is made safe."""

from __future__ import annotations

import contextlib
import gc
import os
import re
import select
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any
from weakref import WeakSet

import rclpy
import rclpy.logging
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from eschorty_ros.control.heartbeat import CHECK_S
from eschorty_ros.core.base.errors import ArgumentError, EschortyError
from eschorty_ros.hardware.base.launcher import end_with_launcher
from eschorty_ros.nodes.ros.alone import SecondNodes
from eschorty_ros.nodes.ros.dds import use_profile
from eschorty_ros.nodes.ros.dds_deadlock import DdsDeadlock, DdsDeadlockError
from eschorty_ros.nodes.ros.executor import Spinning
from eschorty_ros.nodes.ros.freed_memory import FreedMemory
from eschorty_ros.nodes.ros.unused import refuse_unused

_START_TURN_S = 0.1
# An error of a timer ends the node after half a second at most; each turn wakes the process.
_TURN_S = 0.5
_CLOSE_S = 3.0
_SIGNALS_MAX = 64
_ENDINGS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_ending: WeakSet[Node] = WeakSet()
_REASON_MAX = 240
_HELP = """
It is a ROS 2 node, which runs until Ctrl-C. Names and parameters follow --ros-args:
  {0} --ros-args -r __ns:=/eschorty -p NAME:=VALUE --params-file FILE
docs/interfaces.md lists them, and `ros2 param describe` of a running node."""


def make_safe(nodes: Sequence[Node]) -> None:
    """Call ``safe_state()`` of every node that has one, also after the failure of another.

    Those with ``SAFE_FIRST`` come first: other devices may take seconds. It uses the drivers
    directly, because the ROS context may be invalid.
    """
    for node in nodes:
        _ending.add(node)
    for node in sorted(nodes, key=lambda node: not getattr(node, "SAFE_FIRST", False)):
        safe_state = getattr(node, "safe_state", None)
        if safe_state is None:
            continue
        try:
            safe_state()
        except Exception as error:
            # A terminal that is gone must not keep the other nodes from it.
            with contextlib.suppress(OSError):
                print(f"{node.get_name()}: not safe: {error}", file=sys.stderr, flush=True)


def ends(node: Node) -> bool:
    """Return whether the node is on its way out."""
    return node in _ending or not node.context.ok()


@contextlib.contextmanager
def unless_shut_down(node: Node) -> Iterator[None]:
    """Suppress the errors of a context that a signal has ended."""
    try:
        yield
    except (_rclpy.RCLError, _rclpy.InvalidHandle):
        if not ends(node):
            raise


class _Ending:
    """The request of SIGINT, SIGTERM or SIGHUP to end.

    Until rclpy is initialised it raises ``KeyboardInterrupt``, later it is only noted: an exception
    in a callback would leave half-made objects, and an ended context would make callbacks fail.
    """

    def __init__(self) -> None:
        # No event: it has a lock, which the main thread may hold when the signal comes.
        self.requested = False
        self.starting = True
        for number in _ENDINGS:
            signal.signal(number, self._request)

    def _request(self, *_: object) -> None:
        interrupts, self.starting, self.requested = self.starting, False, True
        if interrupts:
            raise KeyboardInterrupt


def _ignore_signals() -> dict[signal.Signals, Any]:
    """Ignore the signals that end a process; return their handlers."""
    return {number: signal.signal(number, signal.SIG_IGN) for number in _ENDINGS}


@contextlib.contextmanager
def signals_ignored() -> Iterator[None]:
    """Ignore the signals that end a process inside the context, so that it reaches a safe state."""
    kept = _ignore_signals()
    try:
        yield
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)


@contextlib.contextmanager
def _signal_pipe() -> Iterator[int]:
    """Give a file descriptor that becomes readable when a signal comes."""
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    before = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    try:
        yield reading
    finally:
        signal.set_wakeup_fd(before)
        os.close(reading)
        os.close(writing)


def run(*factories: Callable[[], Node], threads: int = 1, args: Sequence[str] | None = None) -> int:
    """Build the nodes, spin them until a signal, make the hardware safe; return the exit code.

    Signals stay ignored afterwards, because the process is to end.

    - ``factories``: Each makes one node in the context.
    - ``threads``: Threads of the executor; more than one where a callback waits (actions).
    - ``args``: Command line; that of the process when omitted. ``--help`` starts nothing.

    Returns 0 after Ctrl-C, SIGTERM or SIGHUP; 1 when a node could not be built, another of its
    name runs, or a timer raised an ``EschortyError`` (one line). The process ends with 1
    where DDS does not answer any more.
    """
    words = sys.argv[1:] if args is None else args
    if "--help" in words or "-h" in words:
        for factory in factories:
            print(sys.modules[getattr(factory, "func", factory).__module__].__doc__)
        print(_HELP.format(Path(sys.argv[0]).name))
        return 0
    if words and words[0] != "--ros-args":
        # ROS takes these for its old remap rules, or ignores them.
        print(f"error: {words[0]!r} is unknown; names and parameters follow --ros-args",
              file=sys.stderr)  # fmt: skip
        return 1
    nodes: list[Node] = []
    second: SecondNodes | None = None
    spinning: Spinning | None = None
    code = 0
    deadlocked = False
    use_profile()
    end_with_launcher()
    try:
        ending = _Ending()
        _initialise(args)
        ending.starting = False
        spinning = Spinning(threads)
        for factory in factories:
            nodes.append(factory())
            refuse_unused(nodes[-1], words)
            spinning.executor.add_node(nodes[-1])
        second = SecondNodes(nodes)
        second.wait()
        # What lives as long as the process need not be searched, which halts all threads.
        gc.freeze()
        spinning.start()
        dds, freed = DdsDeadlock(), FreedMemory()
        with _signal_pipe() as signals:
            while rclpy.ok() and not ending.requested:
                spinning.raise_error()
                second.look()
                dds.look()
                freed.trim()
                turn_s = _START_TURN_S if second.looking else _TURN_S
                if select.select([signals], [], [], turn_s)[0]:
                    os.read(signals, _SIGNALS_MAX)
    except KeyboardInterrupt:
        pass
    except EschortyError as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        code, deadlocked = 1, isinstance(error, DdsDeadlockError)
    except Exception:
        # A factory may fail because the context has ended.
        if rclpy.ok():
            traceback.print_exc()
            code = 1
    finally:
        _ignore_signals()
        end_nodes(nodes, second, spinning, deadlocked)
    return code


def _initialise(args: Sequence[str] | None) -> None:
    """Start rclpy; raise ``ArgumentError`` with its reason on one line."""
    # rclpy's log would repeat the reason.
    rclpy.logging.set_logger_level("rcl", rclpy.logging.LoggingSeverity.FATAL)
    try:
        rclpy.init(
            args=list(args) if args is not None else None,
            signal_handler_options=SignalHandlerOptions.NO,
        )
    except Exception as error:
        reason = re.sub(r",? at /[^ ,;]+:\d+", "", " ".join(str(error).split()))[:_REASON_MAX]
        secured = os.environ.get("ROS_SECURITY_ENABLE") == "true"
        remedy = "ROS_SECURITY_KEYSTORE" if secured else "--ros-args"
        raise ArgumentError(f"ROS does not start: {reason}; look at {remedy}") from error
    rclpy.logging.set_logger_level("rcl", rclpy.logging.LoggingSeverity.UNSET)


def _exit_without_dds(nodes: Sequence[Node]) -> None:
    """Close the devices, for as long as DDS lets it, and end the process."""

    def close() -> None:
        for node in nodes:
            node.destroy_node()

    closing = threading.Thread(target=close, daemon=True)
    closing.start()
    closing.join(_CLOSE_S)
    os._exit(1)


def end_nodes(
    nodes: list[Node],
    second: SecondNodes | None,
    spinning: Spinning | None,
    deadlocked: bool = False,
) -> None:
    """Make the hardware safe, end the nodes and leave DDS; where DDS is deadlocked, the process.

    Nodes leave DDS when nothing refers to them any more, no variable either. Until then others list
    them, for 20 s where the process ends before. Callbacks end before the context: what they take
    from an ended one may crash rclpy 9.1's EventsExecutor.
    """
    # A callback must not switch on what has been made safe.
    if spinning is not None:
        spinning.stop_callbacks()
    make_safe(nodes)
    if deadlocked:
        _exit_without_dds(nodes)
    if spinning is not None:
        spinning.end()
    if second is not None:
        second.end()
    while nodes:
        nodes.pop().destroy_node()
    rclpy.try_shutdown()
    # Threads of heartbeats end with their next look at the context.
    time.sleep(2.0 * CHECK_S)
    gc.unfreeze()
    gc.collect()
