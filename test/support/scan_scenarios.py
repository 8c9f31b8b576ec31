"""Scenarios of a scan with their assertions, for the process tests and the launch tests."""

import contextlib
import math
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from action_msgs.msg import GoalStatus
from benches import NARROW_STEPS
from eschorty_ros.action import Scan
from eschorty_ros.msg import LaserState
from nav_msgs.msg import Odometry
from output_log import read_output_log
from ros_process import Observer, ros_minus_steady_ns, stamped_after, wait_until
from sensor_msgs.msg import PointCloud2

from eschorty_ros.core.optics import load_calibration
from eschorty_ros.core.storage import POINT_DTYPE
from eschorty_ros.live.device_messages import ns_from_stamp
from eschorty_ros.nodes.ros import qos
from eschorty_ros.nodes.ros.cloud_messages import points_from_message
from eschorty_ros.report.accuracy import lit_columns, range_error_mm

EVENTS = "qos_overrides./eschorty/camera/events"
SCENE = "steps"
EDGE_MM = 4.0
CALIBRATION = "config_3"
START_M, STOP_M, SPEED_M_S, FREQUENCY_HZ = 0.020, 0.040, 0.050, 70.0
PERIODS = round((STOP_M - START_M) / SPEED_M_S * FREQUENCY_HZ)
BUT_ONE = 0.98 - 1.0 / PERIODS
"""Completeness of a scan whose first or last period may be cut."""
SLOW_HZ, SLOW_M_S, FAR_M = 20.0, 0.010, 0.200
"""Of sweeps that are interrupted: few events, and interrupted far from their end."""
SLOW = {"stop": FAR_M, "speed": SLOW_M_S, "frequency": SLOW_HZ}
SWEPT_POINTS = 10_000
# The feedback also counts points outside start to stop, as many as the stage's begin takes on a
# busy computer.
KEPT_POINTS = SWEPT_POINTS // 4
CLOCK_S = 0.01
PAUSE_NS = 500_000_000
SCAN_DEADLINE_S = 300.0
DARK_S, CUT_OFF_S = 1.5, 5.0


def bench_settings(laser_log: Path) -> dict[str, Any]:
    """The bench that the scans are done on."""
    return {"scene": SCENE, "calibration": CALIBRATION, "seed": 7, "laser_log": str(laser_log)}


def device_parameters(folder: Path) -> dict[str, dict[str, Any]]:
    """Modules and parameters of the nodes at the bench in ``folder``; its stage gives triggers."""
    return {
        "eschorty_ros.nodes.laser.node": {"bench": folder},
        "eschorty_ros.nodes.stage.node": {"bench": folder},
        "eschorty_ros.nodes.camera.node": {
            "bench": folder,
            "trigger_in_mode": "external",
            f"{EVENTS}.publisher.reliability": "reliable",
        },
    }


def node_parameters(folder: Path) -> dict[str, dict[str, Any]]:
    """Modules and parameters of the five nodes of a scan at the bench in ``folder``."""
    return {
        **device_parameters(folder),
        "eschorty_ros.nodes.reconstruction.node": {
            "calibration": CALIBRATION,
            "trigger_source": "stage",
            f"{EVENTS}.subscription.reliability": "reliable",
        },
        "eschorty_ros.nodes.scanner.node": {},
    }


class Goals:
    """Goals of one action of ``node``, one after the other."""

    def __init__(self, observer: Observer, action: Any, name: str, node: str) -> None:
        self._observer, self._action, self._node = observer, action, node
        self.client = observer.action_client(action, name)
        self.feedback: list[Any] = []
        self._ended: Any = None

    def start(self, **goal: Any) -> Any:
        """Send a goal; the accepted handle."""
        # First, because the action of a node that has just ended may still be discovered.
        self._observer.wait_for_answers(self._node, SCAN_DEADLINE_S)
        wait_until(self.client.server_is_ready, "the action", SCAN_DEADLINE_S)
        # A new list, because feedback of the goal before may still come.
        feedback = self.feedback = []
        sent = self.client.send_goal_async(
            self._action.Goal(**goal),
            feedback_callback=lambda message: feedback.append(message.feedback),
        )
        wait_until(sent.done, "an answer to the goal")
        handle = sent.result()
        self._ended = handle.get_result_async()
        return handle

    def end(self) -> tuple[int, Any]:
        """Wait for the end of the last goal: status and result."""
        wait_until(self._ended.done, "the goal's end", SCAN_DEADLINE_S)
        return self._ended.result().status, self._ended.result().result

    def wait_for(self, condition: Callable[[Any], bool], what: str) -> None:
        """Wait for such feedback of the last goal, which must not end before."""

        def given() -> bool:
            assert not self._ended.done(), self._ended.result().result.message
            return any(map(condition, list(self.feedback)))

        wait_until(given, what, SCAN_DEADLINE_S)


class Bench:
    """The test's view of the instrument."""

    def __init__(self, observer: Observer, domain: int, laser_log: Path) -> None:
        self.observer = observer
        self.domain = domain
        self.laser_log = laser_log
        self.clouds = observer.collect(PointCloud2, "scan/points", qos.latched())
        self.laser = observer.collect(LaserState, "laser/state", qos.latched(qos.STATE_HISTORY))
        self.odometry = observer.collect(Odometry, "stage/odom", qos.stream())
        self.scans = Goals(observer, Scan, "scan", "scanner")

    def start(self, **goal: float) -> Any:
        values = {"start": START_M, "stop": STOP_M, "speed": SPEED_M_S, "frequency": FREQUENCY_HZ}
        return self.scans.start(**{**values, **goal})

    def scan(self, **goal: float) -> tuple[int, Any]:
        self.start(**goal)
        return self.scans.end()

    def wait_for_sweep(self, points: int = SWEPT_POINTS) -> None:
        """Wait until more than so many points of the sweep have been reconstructed."""
        self.scans.wait_for(lambda f: f.phase == "sweeping" and f.points > points, "the sweep")

    def cloud_after(self, count: int, points: int) -> np.ndarray:
        """Cloud of so many points, published after ``count`` clouds were there.

        The cloud of a scan that was left open may come before it.
        """
        wait_until(
            lambda: len(self.clouds) > count and self.clouds[-1].width == points,
            f"a cloud of {points} points",
        )
        message = self.clouds[-1]
        assert message.header.frame_id == "eschorty_base"
        seen = points_from_message(message)
        assert seen.dtype.names == POINT_DTYPE.names
        _assert_in_order(seen)
        return seen.astype(POINT_DTYPE)

    def lit_part(self, points: np.ndarray) -> tuple[np.ndarray, float]:
        """Points of the newest cloud made in the last light, and how long it lasted after them (s).

        A scan also holds points that the background makes without light, at any stage position.
        """
        times_ns = self._last_light_ns()
        on_ns, off_ns = times_ns[0], times_ns[-1]
        begun_ns = ns_from_stamp(self.clouds[-1].header.stamp) - ros_minus_steady_ns()
        t_s = points["t"] + 1e-9 * (begun_ns - on_ns)
        lit_s = 1e-9 * (off_ns - on_ns)
        lit = (t_s > -CLOCK_S) & (t_s < lit_s + CLOCK_S)
        return points[lit], lit_s - float(t_s[lit].max())

    def dark_periods(self) -> int:
        """Periods that pauses of the last light can have cost: a renewal that comes late pauses it.

        A pause may cut the periods before and after it.
        """
        times_ns = self._last_light_ns()
        pauses_s = [
            1e-9 * (on - off) for off, on in zip(times_ns[1::2], times_ns[2::2], strict=False)
        ]
        print(f"pauses of the light: {[round(pause_s, 3) for pause_s in pauses_s]} s")
        return sum(math.ceil(pause_s * FREQUENCY_HZ) + 1 for pause_s in pauses_s)

    def _last_light_ns(self) -> list[int]:
        """Return the times at which the output went on, off, on, ..., off in the last light."""
        times_ns = [t_ns for t_ns, _ in read_output_log(self.laser_log)]
        on = len(times_ns) - 2
        while on >= 2 and times_ns[on] - times_ns[on - 1] < PAUSE_NS:
            on -= 2
        return times_ns[on:]

    def output_lines(self) -> list[str]:
        """ON and OFF in the order of the emulator's own log."""
        return [output for _, output in read_output_log(self.laser_log)]

    def assert_off_and_at_rest(self) -> None:
        """Laser off by the emulator's own log and by the node; stage not moving."""
        wait_until(lambda: self.output_lines()[-1] == "OFF", "OFF in the emulator's log")
        now_ns = time.time_ns()
        wait_until(lambda: stamped_after(self.laser, now_ns), "a new laser/state")
        assert self.laser[-1].output == LaserState.OUTPUT_OFF
        wait_until(lambda: stamped_after(self.odometry, now_ns), "new odometry")
        assert self.odometry[-1].twist.twist.linear.y == 0.0


@contextlib.contextmanager
def bench(domain: int, laser_log: Path) -> Iterator[Bench]:
    with Observer(domain) as observer:
        yield Bench(observer, domain, laser_log)


def assert_accurate(points: np.ndarray, positions_mm: np.ndarray, completeness: float) -> None:
    """At least ``completeness`` of the lit columns, and the project's bounds on their errors.

    The errors are those of points whose beam, 7 mm along the stage, lies on one level: the number
    of other points depends on where the scan ends.
    """
    model, scene = load_calibration(CALIBRATION).model(), NARROW_STEPS
    error_mm = range_error_mm(points, scene, model)
    known = np.isfinite(error_mm)
    share = np.count_nonzero(known) / int(lit_columns(scene, model, positions_mm).sum())
    band_mm = scene.stage_band_mm
    y_mm = 1e3 * points["y"]
    inside = known & (np.abs((y_mm + 0.5 * band_mm) % band_mm - 0.5 * band_mm) > EDGE_MM)
    signed_mm, where_mm = error_mm[inside], y_mm[inside]
    median_mm, p95_mm = np.median(np.abs(signed_mm)), np.percentile(np.abs(signed_mm), 95.0)
    found = f"{share:.4f} of the lit points, error median {median_mm:.3f}, p95 {p95_mm:.3f} mm"
    print(found)
    for begin in range(int(where_mm.min()), int(where_mm.max()) + 1, 5):
        part = signed_mm[(where_mm >= begin) & (where_mm < begin + 5)]
        if part.size:
            print(f"  from {begin} mm: {part.size} points, off by {np.median(part):+.3f} mm")
    assert share >= completeness, found
    assert median_mm <= 0.7, found
    assert p95_mm <= 2.5, found


def positions_mm() -> np.ndarray:
    """Positions of a full scan's periods."""
    return 1e3 * (START_M + (STOP_M - START_M) * (np.arange(PERIODS) + 0.5) / PERIODS)


def full_scan(bench: Bench) -> None:
    """A scan to its end gives the expected cloud."""
    before = len(bench.clouds)
    status, result = bench.scan()
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    assert result.success, result.message
    completeness = BUT_ONE - bench.dark_periods() / PERIODS
    assert result.verdict == "complete" or result.completeness > completeness, result.message
    points, _ = bench.lit_part(bench.cloud_after(before, result.points))
    assert len(points) >= 0.99 * result.points
    assert result.packets_lost == 0
    assert abs(int(_profile_of(points)[-1]) + 1 - PERIODS) <= 2
    assert_accurate(points, positions_mm(), completeness)
    sweep_s = (
        result.sweep_stop.sec - result.sweep_start.sec
        + 1e-9 * (result.sweep_stop.nanosec - result.sweep_start.nanosec)
    )  # fmt: skip
    # Where the controller's answers are late, the time of the sweep is as uncertain as they are.
    assert math.isclose(sweep_s, (STOP_M - START_M) / SPEED_M_S, rel_tol=0.25), sweep_s
    assert "sweeping" in [f.phase for f in bench.scans.feedback]
    assert 0.0 < result.sigma_median < 2e-3
    bench.assert_off_and_at_rest()


def cut_off(bench: Bench, cut: Callable[[], Any], join: Callable[[], Any]) -> None:
    """Camera, laser and stage become unreachable: dark, the goal ends, later scans work."""
    before = len(bench.clouds)
    bench.start(**SLOW)
    bench.wait_for_sweep()
    cut()
    begun_s = time.monotonic()
    wait_until(lambda: bench.output_lines()[-1] == "OFF", "OFF in the emulator's log")
    dark_s = time.monotonic() - begun_s
    status, result = bench.scans.end()
    ended_s = time.monotonic() - begun_s
    print(f"dark after {dark_s:.2f} s, ended after {ended_s:.2f} s: {result.message}")
    join()
    joined_ns = time.time_ns()
    assert status == GoalStatus.STATUS_ABORTED, result.message
    assert dark_s < DARK_S
    assert ended_s < CUT_OFF_S
    assert len(bench.cloud_after(before, result.points)) > KEPT_POINTS

    def at_rest() -> bool:
        resting = bench.odometry[-1].twist.twist.linear.y == 0.0
        return resting and stamped_after(bench.odometry, joined_ns)

    # The request to stop arrives when the stage can be reached again.
    wait_until(at_rest, "the stage at rest")
    assert bench.odometry[-1].pose.pose.position.y < FAR_M - 0.005
    bench.assert_off_and_at_rest()
    full_scan(bench)


def assert_refused(bench: Bench, order: Callable[..., tuple[int, Any]], cases: Iterable) -> None:
    """Each goal of ``cases`` is aborted with these words, without any light."""
    lines = len(bench.output_lines())
    for goal, words in cases:
        status, result = order(**goal)
        assert status == GoalStatus.STATUS_ABORTED, goal
        assert not result.success
        for word in words:
            assert word in result.message, (goal, result.message)
    assert len(bench.output_lines()) == lines


def camera_killed(bench: Bench, kill: Callable[[], Any]) -> Any:
    """The camera's process dies mid-scan: aborted, the camera named, light off, points kept.

    Returns the scan's result.
    """
    before = len(bench.clouds)
    # Slow: DDS holds all messages for some seconds after a process was killed.
    bench.start(**SLOW)
    bench.wait_for_sweep()
    kill()
    killed_s = time.monotonic()
    status, result = bench.scans.end()
    print(f"goal ended {time.monotonic() - killed_s:.1f} s after the camera: {result.message}")
    assert status == GoalStatus.STATUS_ABORTED
    assert "camera" in result.message, result.message
    bench.assert_off_and_at_rest()
    assert bench.odometry[-1].pose.pose.position.y < FAR_M - 0.005
    assert_partial(bench, before, result, to_the_end=False)
    return result


def assert_partial(bench: Bench, before: int, result: Any, *, to_the_end: bool) -> None:
    """The cloud reaches ``to_the_end`` of the light, or of the events that a camera had sent."""
    points, light_after_s = bench.lit_part(bench.cloud_after(before, result.points))
    assert len(points) > KEPT_POINTS
    begin_m, reached_m = float(points["y"].min()), float(points["y"].max())
    assert begin_m >= START_M - 1e-6
    assert reached_m < FAR_M - 0.005
    points_s = float(np.ptp(points["t"]))
    print(f"points of {points_s:.2f} s, then light for {light_after_s:.2f} s")
    if to_the_end:
        # The last period is cut by the end of the light.
        assert light_after_s < 2.0 / SLOW_HZ
    periods = int(points_s * SLOW_HZ) + 1
    positions = 1e3 * (begin_m + SLOW_M_S / SLOW_HZ * np.arange(periods))
    assert_accurate(points, positions, 0.9)


def _profile_of(points: np.ndarray) -> np.ndarray:
    """Number of each point's period: within one, columns ascend."""
    return np.cumsum(np.diff(points["column"].astype(int), prepend=-1) <= 0)


def _assert_in_order(points: np.ndarray) -> None:
    """By period, then column; ``t`` begins at the stamp."""
    assert points["t"].min() == 0.0
    profile = _profile_of(points)
    middle = np.bincount(profile, points["t"]) / np.bincount(profile)
    assert (np.diff(middle) > 0.0).all()
