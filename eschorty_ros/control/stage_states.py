"""What a stage's odometry has still to tell."""

from __future__ import annotations

from eschorty_ros.hardware.base.protocols import LinearStage, StageState

# Odometry of so many periods is made up for.
FILL_MAX = 200
# A newest time further back than this comes of a clock that was set.
_CLOCK_BACK_NS = 100_000_000


def new_states(stage: LinearStage, told_ns: int, period_ns: int) -> list[StageState]:
    """States since the last one told, in time order; a pause leaves no gap.

    Parameters
    ----------
    stage : LinearStage
    told_ns : int
        Time of the last state told. When the clock has been set back, what is told goes on from
        the newest.
    period_ns : int
        Distance of the states that a pause left out.

    Raises
    ------
    DeviceError
        When the stage has failed.
    """
    newest = stage.state()
    if told_ns - _CLOCK_BACK_NS <= newest.t_ns <= told_ns:
        return []
    missed = range(told_ns + period_ns, newest.t_ns - period_ns // 2, period_ns)
    # After a longer silence the past is over.
    fill = missed if len(missed) <= FILL_MAX else ()
    # Where the axis had no reference yet, nothing is told afterwards.
    told = [(t_ns, stage.state(t_ns)) for t_ns in fill]
    return [*(state for t_ns, state in told if state.t_ns == t_ns), newest]
