"""Running nodes: one way from ``init`` to a clean exit, with the hardware safe on every path."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import rclpy
from rclpy.executors import (
    Executor,
    ExternalShutdownException,
    MultiThreadedExecutor,
    SingleThreadedExecutor,
)
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node

from eschorty_ros.core.base.errors import EschortyError
from eschorty_ros.nodes.ros.dds import use_profile

_BREATH_S = 3e-4


def make_safe(nodes: Sequence[Node]) -> None:
    """Call ``safe_state()`` of every node that has one; a failure does not keep the next from it.

    It reaches the drivers directly: after a signal the ROS context is already invalid.
    """
    for node in nodes:
        safe_state = getattr(node, "safe_state", None)
        if safe_state is None:
            continue
        try:
            safe_state()
        except Exception as error:
            print(f"{node.get_name()}: not safe: {error}", file=sys.stderr, flush=True)


@contextlib.contextmanager
def unless_shut_down(node: Node) -> Iterator[None]:
    """Swallow the errors of a context that a signal has ended meanwhile: nobody is left to tell."""
    try:
        yield
    except (_rclpy.RCLError, _rclpy.InvalidHandle):
        if node.context.ok():
            raise


def _interrupt_at_first() -> Callable[[], None]:
    """Let Ctrl-C interrupt what comes before a call of what is returned; later it ends the context.

    An exception in the middle of a callback would leave half-made objects to their finalizers.
    """
    # No lock, as an event has: the signal may come while the main thread holds it.
    starting = True

    def interrupt(*_: object) -> None:
        if starting:
            started()
            raise KeyboardInterrupt

    def started() -> None:
        nonlocal starting
        starting = False

    signal.signal(signal.SIGINT, interrupt)
    return started


def _ignore_signals() -> dict[signal.Signals, Any]:
    """Ignore what ends a process; returns the handlers so far."""
    endings = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    return {number: signal.signal(number, signal.SIG_IGN) for number in endings}


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Within it a second Ctrl-C or SIGTERM cannot interrupt the way to the safe state."""
    kept = _ignore_signals()
    try:
        yield
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)


def turn(executor: Executor) -> None:
    """One turn of a spin loop."""
    executor.spin_once(timeout_sec=0.1)
    # While a callback runs, rclpy 9 polls for the next of its group without a pause and would
    # keep the interpreter from the simulation and the reconstruction.
    time.sleep(_BREATH_S)


def run(*factories: Callable[[], Node], threads: int = 1, args: Sequence[str] | None = None) -> int:
    """Build the nodes, spin them until a signal, make the hardware safe; returns the exit code.

    The process is meant to end then: signals stay ignored.

    Parameters
    ----------
    factories : callables
        Each makes one node once the context exists.
    threads : int
        1 spins in this thread; more gives that many to a ``MultiThreadedExecutor``, needed where
        a callback waits (actions).
    args : sequence of str, optional
        Command line; the process's own when omitted.

    Returns
    -------
    int
        0 after Ctrl-C, SIGTERM or SIGHUP; 1 when a node could not be built or a callback failed
        (one line for an ``EschortyError``).
    """
    nodes: list[Node] = []
    executor: Executor | None = None
    code = 0
    use_profile()
    try:
        started = _interrupt_at_first()
        # Its own handler of SIGINT and SIGTERM ends the context and so the loop below.
        rclpy.init(args=list(args) if args is not None else None)
        started()
        signal.signal(signal.SIGHUP, lambda *_: os.kill(os.getpid(), signal.SIGTERM))
        executor = MultiThreadedExecutor(threads) if threads > 1 else SingleThreadedExecutor()
        for factory in factories:
            node = factory()
            nodes.append(node)
            executor.add_node(node)
        while rclpy.ok():
            turn(executor)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except EschortyError as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        code = 1
    except Exception:
        # A callback that publishes while a signal ends the context fails; that is no news.
        if rclpy.ok():
            traceback.print_exc()
            code = 1
    finally:
        # For good, as the process ends. Shutting rclpy down gives back the handlers before it.
        _ignore_signals()
        make_safe(nodes)
        _tear_down(nodes, executor)
        _ignore_signals()
    return code


def _tear_down(nodes: Sequence[Node], executor: Executor | None) -> None:
    if executor is not None:
        executor.shutdown(timeout_sec=1.0)
    for node in nodes:
        node.destroy_node()
    rclpy.try_shutdown()
