"""One scan through the action, all nodes in one process."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2

from eschorty_ros.action import Scan
from eschorty_ros.control.scan_sequence import ScanRequest, check_request
from eschorty_ros.core.base.progress import Progress
from eschorty_ros.core.storage import POINT_DTYPE, REFLECTANCE_DTYPE, finite_points
from eschorty_ros.emulation.bench.process import START_S
from eschorty_ros.nodes.one_process.composition import Tables, bench_parameters, composition, wait
from eschorty_ros.nodes.ros import qos
from eschorty_ros.nodes.ros.cloud_messages import points_from_message
from eschorty_ros.nodes.stage.parameters import DRIVER_TABLE, stage_limits


@dataclass(frozen=True, slots=True)
class ScanJob:
    """A scan; mm and mm/s.

    ``hardware`` holds the parameters of the nodes of real devices, as ``read_hardware`` returns
    them; without it the devices are emulated. ``record`` is a folder for the recording, ``page``
    host and port of a page in the browser.
    """

    scene: str
    calibration: str
    start_mm: float
    stop_mm: float
    speed_mm_s: float
    frequency_hz: float
    seed: int = 0
    pixels: str = "paper"
    effects: str = "none"
    keep: str = "all"
    hardware: Tables | None = None
    record: Path | None = None
    passes: int = 1
    page: tuple[str, int] | None = None
    organized: bool = False


@dataclass(frozen=True, slots=True)
class ScanResult:
    """The action's result and the cloud (POINT_DTYPE, REFLECTANCE_DTYPE) of `scan/points`.

    ``organized`` is the height map of a job that asks for one; ``verdict`` is ``complete``,
    ``partial`` or ``failed``.
    """

    success: bool
    message: str
    points: NDArray[np.void]
    profiles: int
    events: int
    packets_lost: int
    events_dropped: int
    verdict: str
    completeness: float
    recording: str = ""
    organized: NDArray[np.void] | None = None


def check_job(job: ScanJob) -> None:
    """Raise ``ArgumentError``, in mm, unless the scan is within the stage's parameters."""
    given = (job.hardware or {}).get("stage", {})
    limits = stage_limits({param.name: param.default for param in DRIVER_TABLE} | given)
    request = ScanRequest(
        "", job.start_mm, job.stop_mm, job.speed_mm_s, job.frequency_hz, passes=job.passes
    )
    check_request(request, limits, "mm")


def scan_once(job: ScanJob, feedback: Progress) -> ScanResult:
    """Run all nodes, scan once through the action, end them; the laser is off on every exit.

    Raises ``DeviceError`` when a node fails, or the scanner refuses the goal or takes far too long.
    """
    tables = bench_parameters() if job.hardware is None else {**job.hardware}
    own = {"calibration": job.calibration, "keep": job.keep}
    tables["reconstruction"] = {**tables.get("reconstruction", {}), **own}
    if job.record is not None:
        parent, name = str(job.record.resolve().parent), job.record.resolve().name
        tables["reconstruction"] |= {"record": parent, "record_name": name}
    if job.page is not None:
        tables["viewer"] = dict(zip(("host", "port"), job.page, strict=True))
    if job.organized:
        tables["reconstruction"]["organized"] = "on"
    bench = None
    if job.hardware is None:
        names = ("scene", "calibration", "seed", "pixels", "effects")
        bench = {name: getattr(job, name) for name in names}
    goal = Scan.Goal(
        start=job.start_mm * 1e-3,
        stop=job.stop_mm * 1e-3,
        speed=job.speed_mm_s * 1e-3,
        frequency=job.frequency_hz,
        passes=job.passes,
    )

    def on_feedback(message: Any) -> None:
        state = message.feedback
        feedback(float(state.progress), state.waits_for or f"{state.phase} {state.points:,} points")

    with composition(tables, (Scan, "scan"), bench) as running:
        clouds: list[PointCloud2] = []
        running.client.create_subscription(PointCloud2, "scan/points", clouds.append, qos.latched())
        ended = running.result(goal, on_feedback, feedback)
        if ended.points:
            wait(
                lambda: clouds and len(points_from_message(clouds[-1])) == ended.points,
                START_S,
                "no cloud of this scan came on scan/points",
            )
    cloud = _cloud_points(clouds[-1]) if ended.points else np.empty(0, POINT_DTYPE)
    copied = {field.name for field in fields(ScanResult)} - {"points", "organized"}
    return ScanResult(
        points=finite_points(cloud),
        organized=cloud if cloud.ndim == 2 else None,
        **{name: getattr(ended, name) for name in copied},
    )


def _cloud_points(cloud: PointCloud2) -> NDArray[np.void]:
    received = points_from_message(cloud, organized=True)
    names = received.dtype.names or ()
    points = np.empty(received.shape, REFLECTANCE_DTYPE if "reflectance" in names else POINT_DTYPE)
    for name in points.dtype.names or ():
        points[name] = received[name]
    return points
