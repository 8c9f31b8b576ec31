"""What one scan and one calibration share: the emulated bench, and an action's result."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from rclpy.action import ActionClient

from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.nodes.one_process.composition import START_S, Tables, lossless_events, wait

SLACK_S = 300.0
"""On top of the time that a goal needs: for machines on which an emulated camera falls behind."""

Feedback = Callable[[float, str], None]


class Job(Protocol):
    """What is to be done, as far as the bench has to know."""

    @property
    def scene(self) -> str:
        """Name of the scene or its mesh."""

    @property
    def calibration(self) -> str:
        """The build as designed."""

    @property
    def as_built(self) -> str:
        """The build the bench has, empty where it is as designed."""

    @property
    def seed(self) -> int:
        """Of what the bench draws."""

    @property
    def pixels(self) -> str:
        """Preset of the pixels."""


def bench_parameters() -> Tables:
    """Parameters of the nodes at a bench whose stage triggers the camera."""
    tables = lossless_events()
    tables["camera"]["trigger_in_mode"] = "external"
    tables["reconstruction"]["trigger_source"] = "stage"
    return tables


def bench_options(job: Job) -> dict[str, object]:
    """Options of the bench on which the job is done; its stage triggers the camera."""
    return {
        "scene": job.scene,
        "calibration": job.as_built or job.calibration,
        "seed": job.seed,
        "pixels": job.pixels,
        "trigger": "stage",
    }


def result(
    action: ActionClient[Any, Any, Any],
    goal: Any,
    on_feedback: Callable[[Any], None],
    expected_s: float,
) -> Any:
    """Send a goal and wait for its result; whatever interrupts the waiting cancels it.

    Raises
    ------
    DeviceError
        When the server does not answer, refuses the goal or takes far too long.
    """
    sent = action.send_goal_async(goal, feedback_callback=on_feedback)
    wait(sent.done, START_S, "the action does not answer")
    handle = sent.result()
    if handle is None or not handle.accepted:
        raise DeviceError("the goal was refused; see the message above")
    finished = handle.get_result_async()
    try:
        wait(finished.done, expected_s + SLACK_S, "the action does not end")
    except BaseException:
        handle.cancel_goal_async()
        raise
    return finished.result().result
