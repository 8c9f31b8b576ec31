"""The camera node on the EVK4 driver and the emulated camera."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from camera_on_bench import StillBench
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from eschorty_ros.msg import LaserState
from event_camera_msgs.msg import EventPacket
from evk4_bench import OnDemand, plug
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from ros_process import Observer, nodes_here, wait_until
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from eschorty_ros.core.base.errors import DeviceError
from eschorty_ros.core.evt3 import Decoder
from eschorty_ros.emulation.evk4 import Evk4Model
from eschorty_ros.hardware.camera import evk4
from eschorty_ros.live.device_messages import ns_from_stamp
from eschorty_ros.nodes.camera.node import CameraNode
from eschorty_ros.nodes.ros import qos

BUS = "camera_node"


class Run:
    """A camera node, its messages, and the emulated camera."""

    node: CameraNode

    def __init__(self, observer: Observer, source: OnDemand, model: Any) -> None:
        self.observer, self.source, self.model = observer, source, model
        self.packets = observer.collect(EventPacket, "camera/events", qos.events())
        self.reports = observer.collect(DiagnosticArray, "/diagnostics", qos.stream())
        self.heartbeats = observer.collect(Header, "camera/heartbeat", qos.heartbeat())

    def status(self, condition: Callable[[DiagnosticStatus], bool], what: str) -> DiagnosticStatus:
        def found() -> DiagnosticStatus | None:
            every = (status for array in list(self.reports) for status in array.status)
            return next((status for status in every if condition(status)), None)

        return wait_until(found, what)

    def active(self) -> Run:
        wait_until(lambda: self.node.active, "the node active")
        topic = "/eschorty/camera/events"
        # Best effort: what comes before both ends know each other is lost.
        for ends, other in (
            (self.node.publishers, "get_subscription_count"),
            (self.observer.node.subscriptions, "get_publisher_count"),
        ):
            (end,) = (end for end in ends if end.topic_name == topic)
            wait_until(getattr(end, other), topic)
        return self

    def packets_from(self, count: int) -> list[Any]:
        """Give events until ``count`` more packets arrived; returns these packets."""
        before = len(self.packets)

        def enough() -> bool:
            self.source.give(5)
            return len(self.packets) >= before + count

        wait_until(enough, f"{count} packets")
        return list(self.packets)[before:]


Start = Callable[..., Run]


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch, observer: Observer) -> Iterator[Start]:
    # Shorter waits of the initialisation; the driver's own tests check them.
    monkeypatch.setattr(evk4.Evk4, "_wait", lambda self, seconds: time.sleep(seconds / 100.0))
    with nodes_here(observer.domain) as start_node:

        def begin(plugged: bool = True, model: Evk4Model | None = None, **parameters: Any) -> Run:
            source = OnDemand()
            model = model or Evk4Model(source)
            plug(BUS, *([model] if plugged else []))
            run = Run(observer, source, model)
            backend = f"evk4_bench:backend?{BUS}"
            run.node = start_node(CameraNode, driver="evk4", backend=backend, **parameters)
            return run

        yield begin


def test_events_stream_with_arrival_stamps(start: Start) -> None:
    run = start().active()
    packets = run.packets_from(5)
    stamps = [ns_from_stamp(packet.header.stamp) for packet in packets]
    assert stamps == sorted(stamps)
    assert [packet.seq for packet in run.packets] == sorted(packet.seq for packet in run.packets)
    assert {(packet.width, packet.height) for packet in packets} == {(1280, 720)}
    status = run.status(lambda s: s.message == "streaming", "streaming in the diagnostics")
    values = {value.key: value.value for value in status.values}
    assert (values["serial"], values["firmware"]) == ("00051234", "3.9.0")
    assert {"temperature_c", "drops", "reconnects", "on_events_per_s"} <= set(values)
    wait_until(lambda: run.heartbeats, "a heartbeat")


def test_packets_collect_events_for_longer_while_the_laser_is_off_and_not_armed(
    start: Start,
) -> None:
    run = start().active()
    publisher = run.observer.node.create_publisher(LaserState, "laser/state", qos.latched())

    def last_gap_ns() -> int:
        before, last = run.packets_from(2)[-2:]
        return ns_from_stamp(last.header.stamp) - ns_from_stamp(before.header.stamp)

    publisher.publish(LaserState(frequency=70.0))
    wait_until(lambda: last_gap_ns() >= 100_000_000, "packets of 0.1 s")
    publisher.publish(LaserState(frequency=70.0, armed=True))
    wait_until(lambda: last_gap_ns() < 100_000_000, "shorter packets")


def test_an_unplugged_camera_is_reported_at_once_and_the_stream_restarts_at_zero(
    start: Start,
) -> None:
    # Attempts enough for any delay of the test.
    run = start(reconnect_attempts=1000).active()
    run.packets_from(4)
    run.model.gone = True
    run.status(
        lambda s: s.level == DiagnosticStatus.ERROR and "looking for the camera" in s.message,
        "the loss in the diagnostics",
    )
    assert run.node.active
    assert not run.node.healthy
    wait_until(lambda: run.heartbeats[-1].frame_id.endswith(" stopped"), "a last heartbeat")
    count = len(run.heartbeats)
    time.sleep(0.2)
    assert all(one.frame_id.endswith(" stopped") for one in run.heartbeats[count:])
    run.model.replug()
    wait_until(lambda: run.node.healthy, "the camera back")

    def restarted() -> list[int]:
        """The numbers since the second start; packets of the first may arrive late."""
        run.source.give(5)
        seqs = [packet.seq for packet in list(run.packets)]
        begins = [k for k, seq in enumerate(seqs) if seq == 0]
        return seqs[begins[1] :] if len(begins) > 1 else []

    wait_until(lambda: len(restarted()) > 3, "packets of the new stream")
    assert (seqs := restarted()) == list(range(len(seqs)))


def test_a_camera_that_stays_unplugged_deactivates_the_node(start: Start) -> None:
    run = start(reconnect_attempts=1).active()
    run.model.gone = True
    wait_until(lambda: run.node.state_label == "unconfigured", "the node unconfigured")
    assert "lost, and not back after 1 attempts" in run.node.failure
    assert "\n" not in run.node.failure


def test_absent_camera_is_waited_for(start: Start) -> None:
    run = start(plugged=False)
    status = run.status(lambda s: "waiting" in s.message, "waiting in the diagnostics")
    assert "EVK4 camera: no such device on the bus; check cable, power and serial" in status.message
    statistics = run.observer.call(Trigger, "camera/dump_statistics")
    assert not statistics.success
    assert "the camera is not open" in statistics.message
    plug(BUS, run.model)
    run.active()


def test_biases_are_parameters_that_the_camera_holds(start: Start, tmp_path: Path) -> None:
    path = tmp_path / "kept.bias"
    path.write_text("12 % bias_hpf\n-4 % bias_fo\n")
    run = start(bias_diff_on=30, bias_fo=6, bias_file=str(path)).active()
    names = ("bias_diff_on", "bias_fo", "bias_hpf", "bias_refr")
    assert [run.node.parameters[name] for name in names] == [30, 6, 12, 0]
    accepted, reason = run.observer.set_parameter("camera", "bias_refr", 40)
    assert accepted, reason
    assert dict(run.model.settings.biases)["bias_refr"] == 40
    accepted, reason = run.observer.set_parameter("camera", "bias_fo", 56)
    assert not accepted
    assert "bias_fo is 56; choose -35 to 55" in reason
    answer = run.observer.call(Trigger, "camera/save_biases")
    assert answer.success, answer.message
    assert path.read_text().startswith("30  % bias_diff_on\n0  % bias_diff_off\n6  % bias_fo\n")
    statistics = run.observer.call(Trigger, "camera/dump_statistics")
    assert "bias_refr 40" in statistics.message


def test_after_a_failed_write_the_parameters_are_what_the_camera_holds(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = start().active()
    written = evk4.Evk4.set_bias

    def set_bias(self: evk4.Evk4, name: str, offset: int) -> int:
        if name == "bias_fo":
            raise DeviceError("no answer")
        return written(self, name, offset)

    monkeypatch.setattr(evk4.Evk4, "set_bias", set_bias)
    both = [Parameter("bias_diff_on", value=20), Parameter("bias_fo", value=5)]
    request = SetParametersAtomically.Request(parameters=[p.to_parameter_msg() for p in both])
    answer = run.observer.call(SetParametersAtomically, "camera/set_parameters_atomically", request)
    assert "no answer" in answer.result.reason
    assert dict(run.model.settings.biases)["bias_diff_on"] == 20
    wait_until(lambda: run.node.parameters["bias_diff_on"] == 20, "the bias that was written")
    assert run.node.parameters["bias_fo"] == 0


def test_settings_of_the_sensor_are_parameters(start: Start) -> None:
    run = start(
        mipi_frame_period=2000,
        erc_mode="enabled",
        erc_rate=30_000_000,
        roi=[0, 200, 1280, 300],
        hot_pixels="3,4 5,6",
        trail_filter=True,
        trail_filter_threshold=5000,
        trigger_in_mode="external",
        anti_flicker=True,
        anti_flicker_low=60,
        anti_flicker_high=80,
    ).active()
    seen = run.model.settings
    assert seen.packet_period_us == 2000
    assert seen.event_rate == (6000, 200)
    assert seen.rows_off == frozenset(range(720)) - frozenset(range(200, 500))
    assert seen.pixels_off == {(3, 4), (5, 6)}
    assert seen.noise_filter == ("trail", 5000)
    assert seen.trigger_in
    laser = run.observer.publisher(LaserState, "laser/state", qos.latched())
    laser.publish(LaserState(waveform="square", frequency=70.0, duty=0.5))
    status = run.status(lambda s: "anti-flicker" in s.message, "the warning")
    assert status.level == DiagnosticStatus.WARN
    assert "erases the laser's 70 Hz; switch it off" in status.message


def test_the_region_of_interest_changes_while_the_camera_streams(start: Start) -> None:
    run = start().active()
    accepted, reason = run.observer.set_parameter("camera", "roi", [0, 200, 1280, 300])
    assert accepted, reason
    rows = frozenset(range(720))
    assert run.model.settings.rows_off == rows - frozenset(range(200, 500))
    accepted, reason = run.observer.set_parameter("camera", "roi", [0, 700, 1280, 300])
    assert not accepted
    assert "leaves the sensor" in reason
    # Together with another value that is refused.
    both = [Parameter("roi", value=[0, 100, 1280, 300]), Parameter("bias_fo", value=56)]
    request = SetParametersAtomically.Request(parameters=[p.to_parameter_msg() for p in both])
    answer = run.observer.call(SetParametersAtomically, "camera/set_parameters_atomically", request)
    assert "bias_fo is 56" in answer.result.reason
    assert run.model.settings.rows_off == rows - frozenset(range(200, 500))
    accepted, reason = run.observer.set_parameter("camera", "roi", [0, 0, 1280, 720])
    assert accepted, reason
    assert not run.model.settings.rows_off
    assert len(run.packets_from(2)) >= 2


def test_events_dropped_by_the_rate_control_are_reported(start: Start, tmp_path: Path) -> None:
    still = StillBench(tmp_path)
    run = start(model=still.bench.camera, erc_mode="enabled", erc_rate=300_000).active()

    decoder, counts = Decoder(), []

    def arrived() -> int:
        for packet in run.packets[len(counts) :]:
            counts.append(len(decoder.decode(bytes(packet.events))))
        return sum(counts)

    still.light(500.0)
    still.run(100, arrived)
    dropped = still.statistic("rate_dropped")
    assert dropped > still.statistic("events")
    status = run.status(lambda s: "erc_events_dropped" in s.message, "the loss in the diagnostics")
    assert status.level == DiagnosticStatus.WARN
    values = {value.key: value.value for value in status.values}
    assert 0 < int(values["erc_events_dropped"]) <= dropped
    statistics = run.observer.call(Trigger, "camera/dump_statistics")
    assert "erc_events_dropped" in statistics.message
    assert "erc_rate_hz 300000" in statistics.message
