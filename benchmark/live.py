"""What a reconstruction node sustains: packets in, profiles out, through DDS as shipped.

Usage: python benchmark/live.py [--frequency HZ...] [--packet-ms MS...] [--rate R...]
           [--seconds S] [--reliable] [--soak MINUTES]

A process publishes a simulated line of 1280 columns as EventPackets, with the stage's odometry, at
a multiple of real time into a reconstruction node that is a process of its own; this one subscribes
to profile and points. Each row is one node's life. CPU is that of whole processes; "offline" is the
same stream through the same code without ROS, in this process, per CPU second. "MB" is the node's
memory before the stream, after its first minute and at its end. Latency runs from a
period's end, in the publisher's time, to its profile's arrival. "first ms" is that of the first
profile, which waits while the first events choose the periods of a profile; median and p99 are of
those whose period ends after the first second.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import platform
import subprocess
import sys
import tempfile
import threading
import time
from array import array
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from reconstruct import CALIBRATION

from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.reconstruction import Reconstructor, Settings
from eschorty_ros.report.provenance import cpu_model
from eschorty_ros.simulation.scenes import Plane
from eschorty_ros.simulation.world import World

sys.path.append(str(Path(__file__).parents[1] / "test" / "support"))

SEED, RANGE_MM, COLUMNS = 1, 1320.0, 1280
# A step of TIME_HIGH is 4096 us; 70.3125 Hz and 1 kHz have whole periods in 125 of them.
LOOP_US = 2 * 125 * 4096
NEAR = {70.0: 70.3125}
ODOM_US = 10_000
DRAIN_S, SETTLED_S, MINUTE_S = 10.0, 1.0, 60.0
MINUTE = "1 min"
COLUMNS_SHOWN = {
    "Hz": "7.1f", "ms": "6.3f", "x real": "6.1f", "sent": "8.0f", "lost": "6.0f", "Mev/s": "7.1f",
    "per CPU s": "9.1f", "offline": "8.1f", "cores": "6.2f", "publisher": "9.2f", "MB": "6.0f",
    MINUTE: "6.0f", "MB end": "6.0f", "first ms": "8.1f", "median ms": "9.1f", "p99 ms": "7.1f",
}  # fmt: skip
NODE = "eschorty_ros.nodes.reconstruction.node"


def looped(frequency_hz: float, packet_us: int) -> tuple[list[bytes], int]:
    """Return packets of a stream that can be repeated, and its events."""
    world = World(Plane(RANGE_MM), CALIBRATION, seed=SEED)
    world.set_laser(0, True, Modulation(frequency_hz, on_edge_us=0))
    world.advance(LOOP_US // 2)
    before = world.events
    begin_us = LOOP_US // 2
    ends = range(begin_us + packet_us, begin_us + LOOP_US + 1, packet_us)
    return [world.advance(end_us) for end_us in ends], world.events - before


def later(packet: bytes, loops: int) -> bytes:
    """Return a packet as it is so many loops later."""
    words = np.frombuffer(packet, "<u2").copy()
    high = words >> 12 == 8
    steps = loops * (LOOP_US >> 12) % 0x1000
    words[high] = 0x8000 | ((words[high] & 0xFFF) + steps & 0xFFF)
    return words.tobytes()


def publish(arguments: argparse.Namespace) -> None:
    """Publish the loop at a multiple of real time; print packets sent, begin (ns), CPU seconds."""
    import rclpy
    from eschorty_ros.msg import LaserState
    from event_camera_msgs.msg import EventPacket
    from nav_msgs.msg import Odometry
    from rclpy.node import Node
    from sensor_msgs.msg import TimeReference

    from eschorty_ros.nodes.ros import qos
    from eschorty_ros.nodes.ros.conversions import stamp_from_ns

    packet_us = round(arguments.packet_ms[0] * 1e3)
    packets, _ = looped(arguments.frequency[0], packet_us)
    rclpy.init()
    node = Node("camera", namespace="/eschorty")
    profile = qos.stream(2000) if arguments.reliable else qos.events()
    events = node.create_publisher(EventPacket, "camera/events", profile)
    clock = node.create_publisher(TimeReference, "camera/clock", qos.latched())
    laser = node.create_publisher(LaserState, "laser/state", qos.latched())
    odom = node.create_publisher(Odometry, "stage/odom", qos.stream())
    while not (events.get_subscription_count() and odom.get_subscription_count()):
        time.sleep(0.01)
    begun_ns, begun_s, cpu_s = time.time_ns(), time.monotonic(), time.process_time()
    zero_ns = begun_ns - LOOP_US // 2 * 1000
    reference = TimeReference(source="benchmark")
    reference.header.stamp = stamp_from_ns(zero_ns)
    clock.publish(reference)
    state = LaserState(output=1, requested=1, waveform="square", duty=0.5)
    state.frequency = arguments.frequency[0]
    state.header.stamp = state.output_since = state.phase_epoch = stamp_from_ns(zero_ns)
    laser.publish(state)
    total = round(arguments.seconds * arguments.rate[0] * 1e6 / packet_us)
    odom_us = 0
    for number in range(total):
        loops, index = divmod(number, len(packets))
        t_us = number * packet_us
        due_s = begun_s + (t_us + packet_us) * 1e-6 / arguments.rate[0]
        packet = EventPacket(height=720, width=COLUMNS, seq=number, encoding="evt3")
        packet.events = array("B", later(packets[index], loops))
        packet.header.stamp = stamp_from_ns(begun_ns + (t_us + packet_us) * 1000)
        time.sleep(max(due_s - time.monotonic(), 0.0))
        while odom_us <= t_us + packet_us:
            message = Odometry()
            message.header.stamp = stamp_from_ns(begun_ns + odom_us * 1000)
            message.pose.pose.position.y = odom_us * 1e-9
            odom.publish(message)
            odom_us += ODOM_US
        events.publish(packet)
    print(total, begun_ns, time.process_time() - cpu_s, flush=True)
    time.sleep(DRAIN_S)


class Usage:
    """CPU time and memory of a process."""

    def __init__(self, pid: int) -> None:
        self._pid = pid

    def cpu_s(self) -> float:
        fields = Path(f"/proc/{self._pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def rss_mb(self) -> float:
        pages = int(Path(f"/proc/{self._pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def offline_mev_s(packets: list[bytes], events: int, frequency_hz: float) -> float:
    """Return the events per CPU second of the same stream without ROS."""
    best_s = float("inf")
    for _ in range(3):
        reconstructor = Reconstructor(
            CALIBRATION, Modulation(frequency_hz, on_edge_us=0), Settings()
        )
        begun_s = time.process_time()
        for packet in packets:
            reconstructor.push(packet)
        best_s = min(best_s, time.process_time() - begun_s)
    return 1e-6 * events / best_s


@contextlib.contextmanager
def reconstruction(domain: int, reliable: bool) -> Iterator[subprocess.Popen[bytes]]:
    """Run a node; it ends with the context."""
    command = [sys.executable, "-m", NODE, "--ros-args", "-r", "__ns:=/eschorty"]
    command += ["-p", "calibration:=config_3", "-p", "publish_tf:=false"]
    if reliable:
        topic = "qos_overrides./eschorty/camera/events.subscription.reliability"
        command += ["-p", f"{topic}:=reliable"]
    environment = {**os.environ, "ROS_DOMAIN_ID": str(domain)}
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(command, env=environment, stderr=log)
        try:
            yield process
        finally:
            process.terminate()
            process.wait(30.0)


def measured(arguments: argparse.Namespace) -> tuple[float, ...]:
    """Return one row of the table."""
    from eschorty_ros.msg import ReconstructionState
    from ros_process import Observer
    from sensor_msgs.msg import PointCloud2

    from eschorty_ros.live.device_messages import ns_from_stamp
    from eschorty_ros.nodes.ros import qos

    frequency_hz, packet_ms, rate = (
        arguments.frequency[0],
        arguments.packet_ms[0],
        arguments.rate[0],
    )
    packets, loop_events = looped(frequency_hz, round(packet_ms * 1e3))
    offline = offline_mev_s(packets, loop_events, frequency_hz)
    arrivals_ns: list[tuple[float, int]] = []
    states: list[Any] = []

    def on_profile(message: PointCloud2) -> None:
        arrivals_ns.append((ns_from_stamp(message.header.stamp), time.time_ns()))

    with Observer() as observer, reconstruction(observer.domain, arguments.reliable) as node:
        observer.node.create_subscription(PointCloud2, "profile", on_profile, qos.stream())
        points = observer.collect(PointCloud2, "points", qos.stream())
        observer.node.create_subscription(
            ReconstructionState, "reconstruction/state", states.append, 10
        )
        observer.wait_for_answers("reconstruction", 120.0)
        usage = Usage(node.pid)
        cpu_s, rss_mb = usage.cpu_s(), usage.rss_mb()
        command = [sys.executable, __file__, "--publish", "--rate", str(rate)]
        command += ["--frequency", str(frequency_hz), "--packet-ms", str(packet_ms)]
        command += ["--seconds", str(arguments.seconds)]
        command += ["--reliable"] if arguments.reliable else []
        environment = {**os.environ, "ROS_DOMAIN_ID": str(observer.domain)}
        with subprocess.Popen(
            command, env=environment, stdout=subprocess.PIPE, text=True
        ) as source:
            assert source.stdout is not None
            minute_mb = [math.nan]
            after = threading.Timer(MINUTE_S, lambda: minute_mb.append(usage.rss_mb()))
            after.start()
            sent, begun_ns, publisher_cpu_s = map(float, source.stdout.readline().split())
            after.cancel()
            settled_s, seen = time.monotonic(), -1
            while time.monotonic() - settled_s < 2.0:
                time.sleep(0.1)
                points.clear()
                if states and states[-1].events != seen:
                    settled_s, seen = time.monotonic(), states[-1].events
            cpu_s, state = usage.cpu_s() - cpu_s, states[-1]
            mev, lasted_s = 1e-6 * state.events, arguments.seconds
            stamps_ns, at_ns = np.array(arrivals_ns).T - int(begun_ns)
            # A stamp is that of the first point; the stream and its periods begin together.
            ends_s = np.ceil(stamps_ns * 1e-9 * frequency_hz) / frequency_hz / rate
            latencies_ms = at_ns * 1e-6 - ends_s * 1e3
            settled_ms = latencies_ms[ends_s > SETTLED_S]
            values = (frequency_hz, packet_ms, rate, sent, state.packets_lost, mev / lasted_s,
                      mev / cpu_s, offline, cpu_s / lasted_s, publisher_cpu_s / lasted_s, rss_mb,
                      minute_mb[-1], usage.rss_mb(), latencies_ms[0],
                      *np.percentile(settled_ms, (50.0, 99.0)))  # fmt: skip
            source.kill()
    return values


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frequency", type=float, nargs="+", default=[70.0, 1000.0])
    parser.add_argument("--packet-ms", type=float, nargs="+", default=[1.024, 4.096])
    parser.add_argument("--rate", type=float, nargs="+", default=[0.5, 1.0, 2.0])
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--reliable", action="store_true")
    parser.add_argument("--soak", type=float, metavar="MINUTES", default=0.0)
    parser.add_argument("--publish", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    arguments.frequency = [NEAR.get(hz, hz) for hz in arguments.frequency]
    if arguments.soak:
        arguments.seconds = 60.0 * arguments.soak
    if arguments.publish:
        publish(arguments)
        return
    reliability = "reliable" if arguments.reliable else "best effort"
    print(f"{cpu_model()}; Python {platform.python_version()}; numpy {np.__version__}; "
          f"rclpy {version('rclpy')}; packets {reliability}")  # fmt: skip
    shown = {name: form for name, form in COLUMNS_SHOWN.items() if arguments.soak or name != MINUTE}
    print(*(f"{name:>{int(form.split('.')[0])}}" for name, form in shown.items()))
    for frequency_hz in arguments.frequency:
        for packet_ms in arguments.packet_ms:
            for rate in arguments.rate:
                one = argparse.Namespace(**vars(arguments))
                one.frequency, one.packet_ms, one.rate = [frequency_hz], [packet_ms], [rate]
                values = dict(zip(COLUMNS_SHOWN, measured(one), strict=True))
                print(*(format(values[name], form) for name, form in shown.items()), flush=True)


if __name__ == "__main__":
    main()
