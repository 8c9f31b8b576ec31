"""The states of a stage that its odometry has not published yet."""

from __future__ import annotations

from eschorty_ros.hardware.base.protocols import LinearStage, StageState

# A stall of up to this many periods is filled.
FILL_MAX = 200
REST_NS = 200_000_000
"""Distance of the states of a stage at rest."""
# A newest time further back than this is that of a clock that was set back.
_CLOCK_BACK_NS = 100_000_000


def states_since(
    stage: LinearStage, last_ns: int, period_ns: int, rested: bool = False
) -> list[StageState]:
    """Return the states since ``last_ns`` in time order; a stall leaves no gap.

    - ``last_ns``: Time of the last published state. Where the clock was set back, only the newest
      state is returned.
    - ``period_ns``: Distance of the states that fill a stall.
    - ``rested``: Whether the last published state was at rest.

    Raises ``DeviceError`` when the stage has failed.
    """
    newest = stage.state()
    since_ns = newest.t_ns - last_ns
    rests = rested and not newest.moving
    # One that is a little early is as good.
    if -_CLOCK_BACK_NS <= since_ns <= (REST_NS // 2 if rests else 0):
        return []
    # In a longer stall the stage may have moved.
    if rests and since_ns <= 2 * REST_NS:
        return [newest]
    missed = range(last_ns + period_ns, newest.t_ns - period_ns // 2, period_ns)
    fill = missed if len(missed) <= FILL_MAX else ()
    filled = [(t_ns, stage.state(t_ns)) for t_ns in fill]
    # Where the axis had no reference yet, a state has another time than the requested one.
    return [*(state for t_ns, state in filled if state.t_ns == t_ns), newest]
