"""The services around a scan of one's own camera and stage."""

import math
import os
import subprocess
import time
from types import SimpleNamespace

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from eschorty_ros.srv import BeginScan, EndScan
from event_camera_msgs.msg import EventPacket
from nav_msgs.msg import Odometry
from ros_process import NodeProcess, Observer, Remap, nodes_here
from std_msgs.msg import Header
from waiting import wait_until

from eschorty_ros.control.heartbeat import place
from eschorty_ros.control.laser_interlock import CLIENT_HEARTBEAT
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.core.reconstruction import Settings
from eschorty_ros.live.pipeline import Pipeline
from eschorty_ros.nodes.reconstruction import scan_services
from eschorty_ros.nodes.reconstruction.node import ReconstructionNode
from eschorty_ros.nodes.reconstruction.scan_services import ScanServices
from eschorty_ros.nodes.ros import qos
from eschorty_ros.nodes.ros.spin import make_safe


@pytest.fixture(scope="module")
def devices():
    """An observer of a reconstruction, and its publishers of events and odometry."""
    with (
        Observer() as observer,
        NodeProcess(
            "eschorty_ros.nodes.reconstruction.node", {"frequency": 70.0}, domain=observer.domain
        ),
    ):
        events = observer.publisher(EventPacket, "camera/events", qos.events())
        odometry = observer.publisher(Odometry, "stage/odom", qos.stream())
        yield observer, events, odometry


@pytest.fixture(scope="module")
def renamed(tmp_path_factory):
    """As ``devices``, for another camera driver's topic, with recordings, the first one named."""
    topic, folder = "/event_camera/events", tmp_path_factory.mktemp("recordings")
    parameters = {"frequency": 70.0, "record": os.path.relpath(folder), "record_name": "a"}
    with (
        Observer() as observer,
        NodeProcess(
            "eschorty_ros.nodes.reconstruction.node",
            parameters | {"camera/events": Remap(topic)},
            domain=observer.domain,
        ),
    ):
        events = observer.publisher(EventPacket, topic, qos.events())
        odometry = observer.publisher(Odometry, "stage/odom", qos.stream())
        yield observer, events, odometry, folder


def begin(observer, scan_id, stop=0.1, speed=0.0):
    request = BeginScan.Request(scan_id=scan_id, stop=stop, speed=speed)
    return observer.call(BeginScan, "reconstruction/begin_scan", request)


def end(observer, scan_id):
    return observer.call(EndScan, "reconstruction/end_scan", EndScan.Request(scan_id=scan_id))


def sample(observer):
    message = Odometry()
    message.header.stamp = observer.node.get_clock().now().to_msg()
    return message


def test_a_scan_begins_before_any_odometry_and_not_while_its_publisher_is_silent(devices):
    observer, _, odometry = devices
    assert begin(observer, "first").success
    end(observer, "first")
    odometry.publish(sample(observer))
    time.sleep(2.0)
    refused = begin(observer, "silent")
    assert not refused.success
    assert "nothing on /eschorty/stage/odom for" in refused.message
    assert refused.retry
    odometry.publish(sample(observer))
    answer = begin(observer, "again")
    assert answer.success, answer.message
    end(observer, "again")


def test_a_refused_request_that_was_corrected_begins_its_scan(devices):
    observer, _, odometry = devices
    odometry.publish(sample(observer))
    assert "is not finite" in begin(observer, "corrected", math.inf).message
    assert "speed_mm_s is -50.0" in begin(observer, "corrected", speed=-0.05).message
    answer = begin(observer, "corrected")
    assert answer.success, answer.message
    end(observer, "corrected")


def test_a_second_publisher_is_refused_and_may_be_one_that_was_killed(devices):
    observer, _, odometry = devices
    odometry.publish(sample(observer))
    second = observer.node.create_publisher(EventPacket, "camera/events", qos.events())
    answer = begin(observer, "two")
    observer.node.destroy_publisher(second)
    assert answer.retry
    assert answer.message.startswith(
        "/eschorty/camera/events has 2 publishers (observer, observer); stop all but one, a killed "
        "one is listed for 20 s"
    )
    odometry.publish(sample(observer))


def test_a_second_publisher_of_another_topic_may_be_one_that_was_killed(renamed):
    observer, events, odometry, _ = renamed
    odometry.publish(sample(observer))
    second = observer.node.create_publisher(EventPacket, events.topic_name, qos.events())
    answer = begin(observer, "two")
    observer.node.destroy_publisher(second)
    assert "/event_camera/events has 2 publishers" in answer.message
    assert answer.retry


def test_a_refused_scan_leaves_no_folder_and_its_name_to_the_next(renamed):
    observer, _, odometry, folder = renamed
    odometry.publish(sample(observer))
    used = folder / "a" / "cloud.pcd"
    used.parent.mkdir()
    used.touch()
    assert "is not empty" in begin(observer, "refused").message
    used.unlink()
    answer = begin(observer, "good")
    assert answer.success, answer.message
    assert "'good' is being collected" in begin(observer, "another").message
    wait_until(lambda: [path.name for path in folder.iterdir()] == ["a"], "its folder alone")
    end(observer, "good")
    answer = begin(observer, "next")
    assert answer.success, answer.message
    wait_until(lambda: [path.name for path in folder.iterdir()] == ["next"], "its folder alone")
    assert end(observer, "next").recording == str(folder / "next")


def test_packets_of_another_encoding_are_named_after_a_scan_and_in_the_diagnostics(devices):
    observer, events, odometry = devices
    odometry.publish(sample(observer))
    reports = observer.collect(DiagnosticArray, "/diagnostics", qos.stream())
    assert begin(observer, "evt2").success
    for seq in range(3):
        events.publish(EventPacket(seq=seq, encoding="evt2", width=1280, height=720))
    reason = "encoding is 'evt2'; set the camera to evt3"
    wait_until(
        lambda: any(
            f"the last of camera/events: {reason}" in status.message
            for report in reports
            for status in report.status
        ),
        "the reason in the diagnostics",
    )
    assert end(observer, "evt2").message == f"3 packets were refused, the last: {reason}"


def test_the_end_of_a_scan_is_answered_within_one_wait(monkeypatch):
    """A client waits for it no longer, however the worker divides the time."""
    monkeypatch.setattr(scan_services, "_ASSEMBLE_S", 2.0)

    def in_worker(job, timeout_s):
        time.sleep(0.8 * timeout_s)
        job()
        return True, ""

    with Observer() as observer:
        pipeline = SimpleNamespace(scan_id="long", close_period=lambda *_: None)
        nothing = lambda *_: None  # noqa: E731
        ScanServices(
            observer.node, pipeline, lambda: ("", False), in_worker, lambda: True, 0.0, nothing,
            nothing,
        )  # fmt: skip
        client = observer.node.create_client(EndScan, "reconstruction/end_scan")
        answer = client.call_async(EndScan.Request(scan_id="long"))
        begun_s = time.monotonic()
        wait_until(answer.done, "the answer")
        assert answer.result().message.startswith("scan 'long' is not assembled after 2 s")
        assert time.monotonic() - begun_s < 3.0


def test_the_check_of_the_client_leaves_the_end_to_the_client_that_waits_for_it():
    """Both may find the scan open before the worker begins to end it."""
    build = load_calibration("config_3")
    pipeline = Pipeline(build, Settings(), 1.0, 1.0, 1.0)
    pipeline.begin_scan("open", 0.0, 100.0)
    jobs = []

    def in_worker(job, timeout_s):
        jobs.append(job)
        wait_until(lambda: not timeout_s or len(jobs) == 0, "the worker")
        return True, ""

    with Observer() as observer, subprocess.Popen(["true"]) as ended:
        ended.wait()
        services = ScanServices(
            observer.node, pipeline, lambda: ("", False), in_worker, lambda: True, 0.0,
            lambda _: None, lambda *_: None,
        )  # fmt: skip
        client = observer.node.create_client(EndScan, "reconstruction/end_scan")
        answer = client.call_async(EndScan.Request(scan_id="open"))
        wait_until(lambda: len(jobs) == 1, "the end")
        heartbeats = observer.publisher(Header, CLIENT_HEARTBEAT, qos.heartbeat())
        heartbeats.publish(Header(frame_id=f"{place()} {ended.pid}"))
        wait_until(lambda: len(jobs) == 2, "the check of the client")
        for job in jobs:
            job()
        jobs.clear()
        services.finish()
        wait_until(answer.done, "the answer")
        assert answer.result().success


def test_a_reconstruction_on_its_way_out_reports_at_once_that_it_stops():
    """Its process lives for seconds more, in which a scan's light must not stay on."""
    with Observer() as observer, nodes_here(observer.domain) as start:
        node = start(ReconstructionNode, frequency=70.0)
        heartbeats = observer.collect(Header, "reconstruction/heartbeat", qos.heartbeat())
        wait_until(lambda: heartbeats, "a heartbeat")
        make_safe([node])
        wait_until(lambda: heartbeats[-1].frame_id.endswith(" stopped"), "the report of the stop")
