"""Recordings replayed to the reconstruction node over real DDS: live topics, scan, refusals."""

import dataclasses
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import recorded_scan
from diagnostic_msgs.msg import DiagnosticArray
from eschorty_ros.msg import LaserState, ReconstructionState
from eschorty_ros.srv import BeginScan, EndScan
from event_camera_msgs.msg import EventPacket
from ros_process import NodeProcess, Observer
from sensor_msgs.msg import Image, PointCloud2
from tf2_msgs.msg import TFMessage
from waiting import DEADLINE_S, wait_until

from eschorty_ros.core.optics import load_calibration, save_calibration
from eschorty_ros.core.reconstruction import reconstruct_recording
from eschorty_ros.core.storage import load_recording
from eschorty_ros.live.device_messages import ns_from_stamp
from eschorty_ros.nodes.one_process import launch_arguments
from eschorty_ros.nodes.ros import qos
from eschorty_ros.nodes.ros.cloud_messages import points_from_message
from eschorty_ros.nodes.ros.domain import free_domain
from eschorty_ros.simulation.scenes import named
from eschorty_ros.simulation.world import simulate_recording

NODES = "eschorty_ros.nodes.{}.node"
RELIABLE = "qos_overrides./eschorty/camera/events.subscription.reliability"
RECONSTRUCTION = {"stage_gap": 0.0, RELIABLE: "reliable"}


@pytest.fixture(scope="module")
def live(tmp_path_factory):
    """A reconstruction node, and its topics while 20 mm of steps are replayed in real time."""
    recording = simulate_recording(
        tmp_path_factory.mktemp("live") / "rec",
        named("steps"),
        load_calibration("config_3"),
        start_mm=30.0,
        stop_mm=50.0,
        speed_mm_s=20.0,
        seed=11,
    )
    domain = free_domain()
    with (
        NodeProcess(NODES.format("reconstruction"), RECONSTRUCTION, domain=domain),
        Observer(domain) as observer,
    ):
        topics = {
            name: observer.collect(kind, name, profile)
            for name, kind, profile in (
                ("profile", PointCloud2, qos.stream()),
                ("points", PointCloud2, qos.stream()),
                ("scan/points", PointCloud2, qos.latched()),
                ("event_frame", Image, qos.stream()),
                ("reconstruction/state", ReconstructionState, qos.stream()),
                ("/tf", TFMessage, qos.stream()),
                ("/tf_static", TFMessage, qos.latched()),
                ("/diagnostics", DiagnosticArray, qos.stream()),
            )
        }
        wait_until(lambda: topics["reconstruction/state"], "the node's state")
        replay(recording, 1.0, domain)
        wait_until(lambda: topics["scan/points"], "scan/points")
        seen = len(topics["/diagnostics"])
        wait_until(lambda: len(topics["/diagnostics"]) > seen, "diagnostics")
        # DDS repeats a burst's lost end only after its heartbeat's 3 s.
        wait_until(
            lambda: topics["/tf"][-1].transforms[0].transform.translation.y > 0.04999,
            "the last /tf",
        )
        yield SimpleNamespace(
            topics={name: list(messages) for name, messages in topics.items()},
            growing=topics,
            observer=observer,
            recording=recording,
            expected=reconstruct_recording(recording).points,
        )


def replay(recording, rate, domain):
    """Replay a recording to its end; return what it logged."""
    parameters = {"recording": recording.path, "rate": rate, "timeout": DEADLINE_S}
    with NodeProcess(NODES.format("replay"), parameters, domain=domain) as process:
        assert process.wait() == 0, process.output
        return process.output


def assert_same_points(cloud, expected):
    points = points_from_message(cloud)
    assert len(points) == len(expected) > 20_000
    for name in ("x", "y", "z", "intensity", "sigma", "column"):
        np.testing.assert_array_equal(points[name], expected[name], err_msg=name)
    assert np.ptp(points["t"] - expected["t"]) < 1e-9


def test_each_profile_is_one_period_in_the_moving_frame(live):
    clouds = live.topics["profile"]
    assert len(clouds) > 30
    stamps = [ns_from_stamp(cloud.header.stamp) for cloud in clouds]
    assert (np.diff(stamps) > 0).all()
    for cloud in clouds:
        assert cloud.header.frame_id == "eschorty_link"
        points = points_from_message(cloud)
        assert (np.diff(points["column"].astype(int)) > 0).all()
        assert points["t"].min() == 0
        assert points["t"].max() < 1e9 / 70
        assert (points["y"] == 0.0).all()


def test_live_points_are_the_scans_points(live):
    live_clouds, scan = live.topics["points"], points_from_message(live.topics["scan/points"][-1])
    assert {cloud.header.frame_id for cloud in live_clouds} == {"eschorty_base"}
    together = np.concatenate([points_from_message(cloud) for cloud in live_clouds])
    assert len(together) == len(scan)
    for name in ("x", "y", "z", "sigma"):
        np.testing.assert_array_equal(np.sort(together[name]), np.sort(scan[name]))


def test_live_batches_come_at_most_twenty_times_a_second(live):
    state = live.topics["reconstruction/state"]
    span_s = 1e-9 * (ns_from_stamp(state[-1].header.stamp) - ns_from_stamp(state[0].header.stamp))
    assert len(live.topics["points"]) <= 20 * span_s + 1


def test_event_frame_shows_the_line(live):
    frames = live.topics["event_frame"]
    assert frames
    frame = frames[len(frames) // 2]
    assert (frame.height, frame.width, frame.encoding) == (720, 1280, "mono8")
    picture = np.frombuffer(frame.data, np.uint8).reshape(720, 1280)
    lit = picture > 100
    assert lit.any(axis=0).mean() > 0.9
    assert lit.mean() < 0.2


def test_state_counts_and_advances(live):
    states = live.topics["reconstruction/state"]
    last = states[-1]
    assert (last.packets_lost, last.points_without_stage, last.scan_id) == (0, 0, "")
    assert last.calibration == "config_3"
    assert last.points == len(points_from_message(live.topics["scan/points"][-1]))
    until = [ns_from_stamp(state.processed_until) for state in states]
    assert (np.diff(until) >= 0).all()
    assert any(state.scan_id.startswith("replay-rec-") for state in states)


def test_frames_form_one_chain(live):
    fixed = [t for message in live.topics["/tf_static"] for t in message.transforms]
    static = {t.child_frame_id: t.header.frame_id for t in fixed}
    assert static == {"eschorty_link": "eschorty_stage", "eschorty_optical": "eschorty_link"}
    moving = [t for message in live.topics["/tf"] for t in message.transforms]
    assert {(t.header.frame_id, t.child_frame_id) for t in moving} == {
        ("eschorty_base", "eschorty_stage")
    }
    reached = [t.transform.translation.y for t in moving]
    assert min(reached) == pytest.approx(0.030, abs=1e-6)
    assert max(reached) == pytest.approx(0.050, abs=1e-6)


def test_diagnostics_name_the_counters(live):
    status = live.topics["/diagnostics"][-1].status[0]
    assert status.name == "eschorty/reconstruction"
    assert status.level == b"\x00", status.message
    values = {item.key: item.value for item in status.values}
    assert values["clock"] == "announced"
    assert values["packets_lost"] == values["faults"] == "0"


def test_the_scan_has_the_points_of_the_function_bit_for_bit(live):
    assert_same_points(live.topics["scan/points"][-1], live.expected)


def test_a_second_replay_as_fast_as_possible_gives_the_same_points(live):
    replay(live.recording, 0.0, live.observer.domain)
    clouds = live.growing["scan/points"]
    wait_until(lambda: len(clouds) > 1, "the second scan")
    assert_same_points(clouds[-1], live.expected)


def test_an_interrupted_replay_ends_its_scan_and_the_next_one_has_all_points(live):
    """Until then it repeats the laser's state."""
    clouds = live.growing["scan/points"]
    states = live.observer.collect(LaserState, "laser/state", qos.latched(qos.STATE_HISTORY))
    before = len(clouds)
    parameters = {"recording": live.recording.path, "rate": 0.1, "timeout": DEADLINE_S}
    with NodeProcess(NODES.format("replay"), parameters, domain=live.observer.domain) as process:
        wait_until(lambda: len(states) > 3, "the laser's state, again")
        assert len({ns_from_stamp(state.header.stamp) for state in states}) == len(states)
        assert len({ns_from_stamp(state.output_since) for state in states}) == 1
        assert process.interrupt() == 130
        assert "interrupted; its scan ends with the points so far" in process.output
    wait_until(lambda: len(clouds) > before, "the interrupted scan")
    assert clouds[-1].width < len(live.expected)
    replay(live.recording, 0.0, live.observer.domain)
    wait_until(lambda: len(clouds) > before + 1, "the second scan")
    assert_same_points(clouds[-1], live.expected)


def test_without_points_the_reason_ends_the_replay(live, tmp_path):
    folder = shutil.copytree(live.recording.path, tmp_path / "rec")
    events = (folder / "events.raw").read_bytes()
    (folder / "events.raw").write_bytes(events[: events.index(b"% end\n") + 6])
    parameters, domain = {"recording": folder, "rate": 0.0}, live.observer.domain
    with NodeProcess(NODES.format("replay"), parameters, domain=domain) as process:
        assert process.wait() == 1
        assert "error: no points: no events came; look at the camera" in process.output


def test_a_simulated_clock_that_stands_still_is_refused(live):
    parameters = {"recording": live.recording.path, "use_sim_time": True, "timeout": 2.5}
    with NodeProcess(NODES.format("replay"), parameters, domain=live.observer.domain) as process:
        assert process.wait() == 1
        fault = "use_sim_time is true and /clock gives no time"
        assert f"{fault} yet; waits for 2.5 s at most" in process.output
        assert f"error: {fault} for 2.5 s" in process.output


def test_another_calibration_and_best_effort_events_are_warnings(live, tmp_path):
    live.observer.collect(EventPacket, "camera/events", qos.events())
    shutil.copytree(live.recording.path, tmp_path / "rec")
    other = dataclasses.replace(live.recording.calibration, name="other")
    save_calibration(other, tmp_path / "rec" / "calibration.yaml")
    best_effort = f"best effort and may lose packets; start it with {RELIABLE}:=reliable"
    output = ""
    # A replay may begin before it has discovered the observer.
    for _ in range(3):
        if best_effort not in output:
            output = replay(load_recording(tmp_path / "rec"), 0.0, live.observer.domain)
    assert "the recording is of other and reconstructed with config_3; check" in output
    assert best_effort in output


def test_a_recorded_scan_is_replayed_as_it_was(tmp_path):
    """With its settings, limits, losses, and the laser's start in the middle."""
    source = recorded_scan.source(tmp_path / "source")
    scan = recorded_scan.LiveScan(source, tmp_path / "rec", lost=(40, 41, 46))
    scan.run()
    scan.recorder.wait(DEADLINE_S)
    recording = load_recording(tmp_path / "rec")
    expected = reconstruct_recording(recording).points
    parameters = launch_arguments.replay(
        {item.name: item.default for item in launch_arguments.REPLAY}
        | {"recording": str(recording.path)}
    ).nodes["reconstruction"]
    domain = free_domain()
    with (
        NodeProcess(NODES.format("reconstruction"), parameters, domain=domain),
        Observer(domain) as observer,
    ):
        clouds = observer.collect(PointCloud2, "scan/points", qos.latched())
        output = replay(recording, 0.0, domain)
        wait_until(lambda: clouds, "scan/points")
        points = points_from_message(clouds[-1])
    assert "recorded with trigger_source none, smoothing_half_width 3; for the same" in output
    assert len(points) == len(expected) > 500
    for name in ("x", "y", "z", "sigma", "column"):
        np.testing.assert_array_equal(points[name], expected[name], err_msg=name)


@pytest.mark.parametrize(
    ("name", "words"), [("none", "none"), ("bag", "is a bag; eschorty convert")]
)
def test_what_is_no_recording_is_one_line(tmp_path, name, words):
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "metadata.yaml").touch()
    parameters, domain = {"recording": tmp_path / name}, free_domain()
    with NodeProcess(NODES.format("replay"), parameters, domain=domain) as process:
        assert process.wait() == 1
        lines = [line for line in process.output.splitlines() if line.strip()]
        assert len(lines) == 1, process.output
        assert words in lines[0]


def test_scan_services_refuse_with_a_reason(live):
    observer = live.observer
    # The replay, which publishes the events, has ended.
    request = BeginScan.Request(scan_id="x", stop=1.0)
    begin = observer.call(BeginScan, "reconstruction/begin_scan", request)
    assert not begin.success
    assert "no publisher of" in begin.message
    end = observer.call(EndScan, "reconstruction/end_scan", EndScan.Request(scan_id="x"))
    assert not end.success
    assert "'x' is not being collected" in end.message
