"""Calibrations over real DDS, each node a process of its own."""

import contextlib
import os
import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from benches import NARROW_STEPS, remote_bench
from command_process import CommandProcess
from contact import Contact
from eschorty_ros.action import Calibrate
from eschorty_ros.msg import ActiveCalibration, CalibrationTarget
from eschorty_ros.srv import LoadCalibration, SaveCalibration
from ros_process import NodeProcess, Observer, processes, wait_until
from scan_scenarios import (
    EVENTS,
    SCAN_DEADLINE_S,
    SLOW,
    SLOW_HZ,
    Bench,
    Goals,
    assert_refused,
    device_parameters,
)

from eschorty_ros.core.optics import load_calibration, save_calibration
from eschorty_ros.nodes.ros import qos
from eschorty_ros.nodes.ros.domain import free_domain
from eschorty_ros.report.accuracy import range_error_mm
from eschorty_ros.simulation.scenes import RECEDING_MM
from eschorty_ros.simulation.scenes import bench as bench_of_posts

CALIBRATION, AS_BUILT = "config_3", "config_3_as_built"
KNOWN_SCENE = "steps"
CAMERA = "eschorty_ros.nodes.camera.node"
POSTS = bench_of_posts()
# A capture that is interrupted: few events.
LONG = {"capture_time": 60.0, "frequency": SLOW_HZ}
TRUE_MM = np.linspace(800.0, 2100.0, 131)


def node_parameters(bench_folder: Path, folder: Path) -> dict[str, dict[str, Any]]:
    """Modules and parameters of the five nodes; calibrations are written to ``folder``."""
    return {
        **device_parameters(bench_folder),
        "eschorty_ros.nodes.reconstruction.node": {
            "calibration": CALIBRATION,
            "trigger_source": "stage",
            "calibration_folder": folder,
            f"{EVENTS}.subscription.reliability": "reliable",
        },
        "eschorty_ros.nodes.scanner.node": {},
    }


class CalibrationBench(Bench):
    def __init__(self, observer: Observer, domain: int, laser_log: Path, folder: Path) -> None:
        super().__init__(observer, domain, laser_log)
        self.folder = folder
        self.active = observer.collect(
            ActiveCalibration, "reconstruction/calibration", qos.latched()
        )
        self.calibrations = Goals(observer, Calibrate, "calibrate", "reconstruction")

    def begin(self, **goal: Any) -> Any:
        """Start a calibration with the bench's posts unless others are given; the handle."""
        posts = [CalibrationTarget(range=p.range_mm * 1e-3, size=p.size_mm * 1e-3) for p in POSTS]
        values = {"targets": posts, "capture_time": 0.5, "frequency": 70.0}
        return self.calibrations.start(**{**values, **goal})

    def calibrate(self, **goal: Any) -> tuple[int, Any]:
        self.begin(**goal)
        return self.calibrations.end()

    def wait_for_capture(self) -> None:
        self.calibrations.wait_for(lambda f: f.phase == "capturing" and f.events, "a capture")

    @property
    def newest(self) -> Any:
        wait_until(lambda: self.active, "a latched calibration", SCAN_DEADLINE_S)
        return self.active[-1]

    def wait_for_active(self, calibration_id: str) -> None:
        """Wait until this calibration is the active one; "" is the design."""
        wait_until(lambda: self.newest.id == calibration_id, f"calibration {calibration_id!r}")

    @contextlib.contextmanager
    def nothing_changes(self) -> Iterator[None]:
        """Within it the active calibration and the folder stay as they are."""
        active, count, files = self.newest, len(self.active), sorted(self.folder.glob("*"))
        yield
        assert len(self.active) == count
        assert self.newest is active
        assert sorted(self.folder.glob("*")) == files


def scan_error_mm(bench: CalibrationBench) -> np.ndarray:
    """Scan the known scene; measured minus true range of every point on it."""
    before = len(bench.clouds)
    status, result = bench.scan()
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    points = bench.cloud_after(before, result.points)
    error_mm = range_error_mm(points, NARROW_STEPS, load_calibration(AS_BUILT).model())
    error_mm = error_mm[np.isfinite(error_mm)]
    assert len(error_mm) > 2_500
    median_mm, p95_mm = np.percentile(np.abs(error_mm), (50.0, 95.0))
    print(f"scan: median {np.median(error_mm):+.3f} mm, |error| {median_mm:.3f}, p95 {p95_mm:.3f}")
    return error_mm


def load(bench: CalibrationBench, name: str) -> Any:
    request = LoadCalibration.Request(calibration=name)
    return bench.observer.call(LoadCalibration, "reconstruction/load_calibration", request)


def save(bench: CalibrationBench, name: str = "") -> Any:
    request = SaveCalibration.Request(path=name)
    return bench.observer.call(SaveCalibration, "reconstruction/save_calibration", request)


def assert_not_done(answer: Any, *words: str) -> None:
    assert not answer.success
    assert answer.message
    assert [word for word in words if word not in answer.message] == [], answer.message


class Instrument:
    """The test's view, the running nodes, and a camera that can be pointed elsewhere."""

    def __init__(
        self,
        bench: CalibrationBench,
        running: dict[str, NodeProcess],
        emulated: CommandProcess,
        bench_folder: Path,
    ) -> None:
        self.bench, self.running = bench, running
        self._emulated = emulated
        self._camera = device_parameters(bench_folder)[CAMERA]

    def point_camera_at(self, scene: str) -> None:
        self.running["camera"].interrupt()
        self.running["camera"].kill()
        self._emulated.do(scene)
        self.running["camera"] = NodeProcess(CAMERA, self._camera, domain=self.bench.domain)
        self.bench.observer.wait_for_state("camera", "active")


@pytest.fixture(scope="module")
def instrument(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Instrument]:
    """Five node processes at a bench; the reconstruction's end comes last."""
    log = Path(tmp_path_factory.mktemp("laser")) / "output.log"
    folder = Path(tmp_path_factory.mktemp("calibrations")) / "made"
    domain = free_domain()
    with (
        remote_bench(scene=KNOWN_SCENE, calibration=AS_BUILT, seed=7, laser_log=str(log)) as (
            emulated,
            bench_folder,
        ),
        processes(node_parameters(bench_folder, folder), domain) as running,
        Observer(domain) as observer,
    ):
        bench = CalibrationBench(observer, domain, log, folder)
        yield Instrument(bench, running, emulated, bench_folder)


@pytest.fixture
def bench(instrument: Instrument) -> CalibrationBench:
    return instrument.bench


def test_an_uncalibrated_scan_is_off_by_tens_of_mm(bench: CalibrationBench) -> None:
    """With the design's geometry a known target is off by tens of mm."""
    assert bench.newest.id == ""
    error_mm = scan_error_mm(bench)
    assert 20.0 < abs(np.median(error_mm)) < 99.0


def test_useless_captures_change_nothing(instrument: Instrument) -> None:
    """Captures that show no known targets, or end early, change nothing and leave no light."""
    instrument.point_camera_at("posts")
    bench = instrument.bench
    with bench.nothing_changes():
        # Targets that are not there.
        far = [CalibrationTarget(range=r) for r in (5.0, 6.0, 7.0)]
        status, result = bench.calibrate(targets=far)
        assert status == GoalStatus.STATUS_ABORTED
        assert "0 of 3 targets found among 9 posts" in result.message, result.message
        assert len(result.rejected) == 12
        assert result.frame.data
        bench.assert_off_and_at_rest()
        # The same range twice, which is ambiguous.
        twice = [CalibrationTarget(range=1.0, label=label) for label in ("left", "right")]
        status, result = bench.calibrate(targets=twice)
        assert status == GoalStatus.STATUS_ABORTED
        assert "left and right have the same range" in result.message, result.message
        bench.assert_off_and_at_rest()
        # Canceled.
        handle = bench.begin(**LONG)
        bench.wait_for_capture()
        canceled = handle.cancel_goal_async()
        wait_until(canceled.done, "an answer to the cancel request")
        status, result = bench.calibrations.end()
        assert status == GoalStatus.STATUS_CANCELED, result.message
        bench.assert_off_and_at_rest()
        # The laser goes off.
        contact = Contact(bench.observer)
        bench.begin(**LONG)
        bench.wait_for_capture()
        contact.open()
        status, result = bench.calibrations.end()
        contact.close()
        assert status == GoalStatus.STATUS_ABORTED
        assert "laser: went off: interlock open" in result.message, result.message
        bench.assert_off_and_at_rest()


def test_one_thing_at_a_time(bench: CalibrationBench) -> None:
    """No second calibration, scan or exchange while one is under way, and the other way round."""
    with bench.nothing_changes():
        handle = bench.begin(**LONG)
        bench.wait_for_capture()
        ended = handle.get_result_async()
        _, result = bench.calibrate()
        assert "a calibration is running" in result.message
        _, result = bench.scan()
        assert "a calibration is running" in result.message
        wait_until(handle.cancel_goal_async().done, "an answer to the cancel request")
        wait_until(ended.done, "the canceled calibration's end")
        assert ended.result().status == GoalStatus.STATUS_CANCELED
        handle = bench.start(**SLOW)
        bench.wait_for_sweep(points=100)
        _, result = bench.calibrate()
        assert "is being collected" in result.message
        assert_not_done(load(bench, CALIBRATION), "is being collected")
        wait_until(handle.cancel_goal_async().done, "an answer to the cancel request")
        status, result = bench.scans.end()
        assert status == GoalStatus.STATUS_CANCELED, result.message
    bench.assert_off_and_at_rest()


def test_nine_posts_give_range_within_one_mm(bench: CalibrationBench) -> None:
    """Nine posts give range within 1 mm RMS; result, file and latched message agree."""
    # The command's test takes the other method through the same nodes.
    status, result = bench.calibrate(method="paper")
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    assert result.success
    assert result.message == ""
    assert list(result.rejected) == []
    made = load_calibration(result.file)
    true = load_calibration(AS_BUILT).model()
    error = made.model().range_mm(true.row(TRUE_MM)) - TRUE_MM
    rms_mm = float(np.sqrt(np.mean(error**2)))
    print(f"range RMS {rms_mm:.3f} mm over 0.8 to 2.1 m, residuals "
          f"{np.round(result.residuals, 2).tolist()} px, {list(result.verdicts)}")  # fmt: skip
    assert rms_mm < 1.0
    assert made.id == result.calibration_id
    assert Path(result.file).parent == bench.folder
    assert tuple(result.parameters) == made.parameters_fitted
    values = [getattr(made, name) for name in result.parameters]
    np.testing.assert_allclose(result.values, values, rtol=1e-12)
    size = len(values)
    np.testing.assert_allclose(np.reshape(result.covariance, (size, size)), made.covariance)
    np.testing.assert_allclose(result.ranges, [post.range_mm * 1e-3 for post in POSTS])
    assert len(result.residuals) == len(result.rows) == len(POSTS)
    assert any(line.startswith("identifiable") for line in result.verdicts)
    assert (result.frame.width, result.frame.height) == (1280, 720)
    assert result.frame.encoding == "mono8"
    assert max(result.frame.data) == 255
    bench.wait_for_active(made.id)
    assert bench.newest.file == result.file
    table = dict(zip(bench.newest.parameters, bench.newest.values, strict=True))
    assert table["b_prime_px"] == made.b_prime_px
    # The last feedback may come after the result.
    seen = bench.calibrations.feedback
    wait_until(
        lambda: any(f.matched == len(f.residuals) == len(POSTS) for f in list(seen)),
        "feedback of every post",
    )
    bench.assert_off_and_at_rest()


def test_a_calibrated_scan_is_right_to_one_mm(instrument: Instrument) -> None:
    """With the calibration made before, the same target is within 1 mm."""
    instrument.point_camera_at(KNOWN_SCENE)
    bench = instrument.bench
    assert bench.newest.id
    error_mm = scan_error_mm(bench)
    assert abs(np.median(error_mm)) < 0.5
    assert np.median(np.abs(error_mm)) < 1.0


def test_only_calibrations_of_this_instrument_are_loaded(bench: CalibrationBench) -> None:
    """Only calibrations of this instrument in its folder are loaded; files are whole or absent."""
    own, folder = load_calibration(CALIBRATION), bench.folder
    with bench.nothing_changes():
        for change, words in (
            ({"columns": 640, "principal_column": 319.5}, ("columns", "640", "1280")),
            ({"roi_px": (0, 100, 1280, 400)}, ("roi_px",)),
            ({"name": "config_1"}, ("config_1", "config_3", "build")),
        ):
            save_calibration(replace(own, **change), folder / "other.yaml")
            assert_not_done(load(bench, "other"), *words)
        (folder / "broken.yaml").write_text("name: config_3\n")
        assert_not_done(load(bench, "broken"), "broken.yaml")
        os.mkfifo(folder / "pipe.yaml")
        for name in ("pipe", "../made/other", "/dev/zero", "/etc/shadow", "x" * 5000, "missing"):
            answer = load(bench, name)
            assert_not_done(answer, *["calibration_paths"] * ("/" in name))
            assert len(answer.message) <= 300
        for name in ("pipe", "../other", str(folder / "kept"), "."):
            assert_not_done(save(bench, name), *["calibration_paths"] * ("/" in name))
        for file in ("other", "broken", "pipe"):
            (folder / f"{file}.yaml").unlink()
    active = bench.newest.id
    answer = save(bench, "kept")
    assert (answer.success, answer.file) == (True, str(folder / "kept.yaml")), answer.message
    answer = load(bench, CALIBRATION)
    assert answer.success, answer.message
    bench.wait_for_active("")
    answer = load(bench, "kept")
    assert answer.success, answer.message
    assert answer.id == active
    bench.wait_for_active(active)


def test_bad_goals_are_refused(bench: CalibrationBench) -> None:
    """Each bad value is refused by name, without any light."""
    one = CalibrationTarget(range=1.0)
    cases = (
        ({"targets": [one]}, ("targets holds 1",)),
        ({"targets": [one, CalibrationTarget(range=-1.0)]}, ("range is -1",)),
        ({"method": "magic"}, ("magic", "paper")),
        ({"capture_time": 0.0}, ("capture_time", "0 s")),
        ({"frequency": 5.0}, ("frequency", "5 Hz")),
        ({"sweep_speed": 0.01}, ("targets holds 9", "sweep_speed")),
    )
    with bench.nothing_changes():
        assert_refused(bench, bench.calibrate, cases)


def test_killed_camera_ends_the_calibration(instrument: Instrument) -> None:
    """The camera's process dies during a capture: aborted, named, light off, nothing changed."""
    bench = instrument.bench
    with bench.nothing_changes():
        bench.begin(**LONG)
        bench.wait_for_capture()
        instrument.running["camera"].send(signal.SIGKILL)
        status, result = bench.calibrations.end()
        assert status == GoalStatus.STATUS_ABORTED
        assert "camera" in result.message, result.message
        bench.assert_off_and_at_rest()


def test_a_target_moved_by_the_stage_calibrates_too(instrument: Instrument) -> None:
    """One target that the stage moves back and forth gives range within 1 mm RMS where it was."""
    instrument.point_camera_at("receding")
    bench = instrument.bench
    status, result = bench.calibrate(
        targets=[CalibrationTarget(range=RECEDING_MM * 1e-3)],
        sweep_speed=0.1,
        sweep_start=0.01,
        sweep_stop=0.07,
        range_per_stage=1.0,
    )
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    assert len(result.ranges) > 60
    true = load_calibration(AS_BUILT).model()
    for near_mm, far_mm, bound_mm in ((910.0, 970.0, 0.2), (850.0, 1050.0, 1.0)):
        true_mm = np.linspace(near_mm, far_mm, 101)
        error = load_calibration(result.file).model().range_mm(true.row(true_mm)) - true_mm
        rms_mm = float(np.sqrt(np.mean(error**2)))
        print(f"moved by the stage: range RMS {rms_mm:.3f} mm from {near_mm:g} to {far_mm:g} mm")
        assert rms_mm < bound_mm
    bench.wait_for_active(result.calibration_id)
    bench.assert_off_and_at_rest()


def test_interrupted_reconstruction_leaves_the_laser_off(instrument: Instrument) -> None:
    """The reconstruction ends in a capture: its way out or its lost heartbeat ends the light."""
    bench, process = instrument.bench, instrument.running["reconstruction"]
    bench.begin(**LONG)
    bench.wait_for_capture()
    # A renewal that comes late pauses the light.
    wait_until(lambda: bench.output_lines()[-1] == "ON", "the light")
    process.send(signal.SIGINT)
    wait_until(lambda: bench.output_lines()[-1] == "OFF", "OFF in the emulator's log")
    assert process.wait() == 0, process.output
    assert "Traceback" not in process.output, process.output
