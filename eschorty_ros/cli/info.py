"""`eschorty info`."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from eschorty_ros.cli.console import pairs, progress_bar, warn
from eschorty_ros.cli.files import is_yaml
from eschorty_ros.core.base.errors import FormatError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from eschorty_ros.core.modulation import Modulation
    from eschorty_ros.core.optics import Calibration
    from eschorty_ros.core.storage import ScanLog

PEAK_WINDOW_US = 10_000
_SHOWN = (
    "focal_length_mm", "f_number", "theta_deg", "theta_prime_deg", "k_prime_px", "b_mm",
    "b_prime_px", "id", "date",
)  # fmt: skip


@click.command("info")
@click.argument("path", type=click.Path(exists=True, path_type=Path))
def command(path: Path) -> None:
    """Show the content of PATH: a recording, any file of it, a rosbag2, or a .pcd or .ply cloud.

    \b
    Examples:
      eschorty info rec
      eschorty info rec/events.raw
      eschorty info my_calibration.yaml
      eschorty info scan/scan.pcd
    """  # noqa: D301
    from eschorty_ros.core.optics import load_calibration
    from eschorty_ros.core.reconstruction.stage_faults import stage_faults
    from eschorty_ros.core.storage import (
        LASER_FILE,
        TRUTH_FILE,
        is_cloud,
        load_recording,
        read_laser_yaml,
        read_stage_csv,
        read_truth_csv,
    )
    from eschorty_ros.core.storage.recording import (
        MARKS_FILE,
        SCAN_FILE,
        SETTINGS_FILE,
        read_marks_csv,
        read_scan_yaml,
        read_settings_yaml,
    )
    from eschorty_ros.live.bag_files import BagReader, is_bag

    if is_bag(path):
        with BagReader(path) as bag:
            pairs(f"{path}: a bag", {topic: f"{n:,}" for topic, n in bag.counts().items()})
    elif path.is_dir():
        recording = load_recording(path)
        rows = {"calibration": _in_short(recording.calibration.label, recording.calibration)}
        rows |= _laser(recording.modulation) | _stage(recording.stage_samples)
        if recording.scan is not None:
            rows |= _scan(recording.scan)
        pairs(str(path), rows | _truth(recording.truth))
        gaps = int((recording.marks["packets_lost"] > 0).sum())
        span_us = _raw(recording.events_path, gaps)
        for fault in stage_faults(recording, span_us) if span_us else []:
            warn(fault)
    elif is_cloud(path):
        _cloud(path)
    elif path.name == LASER_FILE:
        pairs(str(path), _laser(read_laser_yaml(path)))
    elif path.name == SCAN_FILE:
        pairs(str(path), _scan(read_scan_yaml(path)))
    elif path.name == SETTINGS_FILE:
        pairs(str(path), {name: str(value) for name, value in read_settings_yaml(path).items()})
    elif path.name == MARKS_FILE:
        marks = read_marks_csv(path)
        pairs(str(path), {"packets lost": f"{marks['packets_lost'].sum():,}",
                          "laser switched on": f"{marks['laser_on'].sum():,} times"})  # fmt: skip
    elif is_yaml(path):
        pairs(str(path), _calibration(load_calibration(path)))
    elif path.name == TRUTH_FILE:
        pairs(str(path), _truth(read_truth_csv(path)))
    elif path.suffix.lower() == ".csv":
        pairs(str(path), _stage(read_stage_csv(path)))
    elif path.suffix.lower() == ".raw":
        _raw(path)
    else:
        raise FormatError(
            f"{path} ends in {path.suffix!r}; give a recording, a file of it, a bag or a cloud"
        )


def _in_short(name: str, calibration: Calibration) -> str:
    near, far = calibration.model().range_limits_mm
    return f"{name} ({near:.1f} to {far:.1f} mm)"


def _calibration(calibration: Calibration) -> dict[str, str]:
    given = {key: value for key, value in calibration.as_dict().items() if key in _SHOWN}
    return {
        "build": _in_short(calibration.name, calibration),
        "sensor": f"{calibration.columns} x {calibration.rows}, {calibration.pixel_um:g} um",
        "k_mm": f"{calibration.object_scale_mm:.6g}",
        **{key: str(value) for key, value in given.items()},
        "fitted": ", ".join(calibration.parameters_fitted or ("nothing",)),
    }


def _laser(laser: Modulation) -> dict[str, str]:
    edge = "unknown" if laser.on_edge_us is None else f"{laser.on_edge_us} us"
    return {
        "laser": f"{laser.waveform}, {laser.frequency_hz:g} Hz, duty {laser.duty:g}",
        "rising edge": edge,
    }


def _stage(samples: NDArray[np.void]) -> dict[str, str]:
    seconds = (int(samples["t_us"][-1]) - int(samples["t_us"][0])) * 1e-6
    position_mm = samples["position_mm"]
    return {
        "stage": f"{position_mm.min():.3f} to {position_mm.max():.3f} mm in {seconds:.3f} s, "
        f"{len(samples):,} samples",
    }


def _scan(scan: ScanLog) -> dict[str, str]:
    from eschorty_ros.core.clocks import POSITION_LIMIT_MM

    limited = scan.stop_mm - scan.start_mm < 2.0 * POSITION_LIMIT_MM
    limits = f", {scan.start_mm:g} to {scan.stop_mm:g} mm" if limited else ""
    return {
        "scan": f"{scan.scan_id}{limits}",
        "recording": "; ".join(scan.faults) or "complete",
    }


def _truth(truth: NDArray[np.void] | None) -> dict[str, str]:
    if truth is None or len(truth) == 0:
        return {"truth": "none" if truth is None else "0 ranges"}
    near, far = truth["range_mm"].min(), truth["range_mm"].max()
    return {"truth": f"{len(truth):,} ranges, {near:.1f} to {far:.1f} mm"}


def _cloud(path: Path) -> None:
    import numpy as np

    from eschorty_ros.core.storage import finite_points
    from eschorty_ros.core.storage.cloud import stored_points

    cloud = stored_points(path)
    points = finite_points(cloud)
    rows = {"points": f"{len(points):,}"}
    if cloud.ndim > 1:
        rows["height map"] = f"{cloud.shape[0]:,} profiles x {cloud.shape[1]:,} columns"
    if len(points):
        for name, unit, scale in (
            ("x", "mm", 1e3),
            ("y", "mm", 1e3),
            ("z", "mm", 1e3),
            ("t", "s", 1.0),
            ("intensity", "events", 1.0),
            ("column", "px", 1.0),
        ):
            values = points[name].astype(np.float64) * scale
            known = values[np.isfinite(values)]
            span = f"{known.min():.3f} to {known.max():.3f} {unit}" if known.size else "not finite"
            odd = len(values) - known.size
            rows[name] = f"{span} ({odd:,} points not finite)" if odd and known.size else span
        sigma = points["sigma"][np.isfinite(points["sigma"])].astype(np.float64)
        rows["median sigma"] = f"{np.median(sigma) * 1e3:.3f} mm" if sigma.size else "not finite"
    pairs(str(path), rows)


def _raw(path: Path, gaps: int = 0) -> tuple[int, int] | None:
    """Show a file of the camera's bytes; return the sensor times of its first and last event.

    ``gaps`` is the number of places where packets are known to be missing.
    """
    import numpy as np

    from eschorty_ros.core.evt3 import Decoder
    from eschorty_ros.core.reconstruction.stream_faults import decoder_counts, stream_faults
    from eschorty_ros.core.storage.raw_file import RawReader

    reader = RawReader(path)
    header = reader.header
    decoder = Decoder(int(header.width), int(header.height))
    events = rising = triggers = on = 0
    first_us = last_us = 0
    busiest: dict[int, int] = {}
    total, done = max(path.stat().st_size, 1), 0
    with progress_bar("decoding") as report:
        for chunk in reader.chunks(1 << 20):
            decoded = decoder.decode(chunk)
            done += len(chunk)
            report(done / total, "")
            triggers += len(decoded.triggers.t)
            rising += int(np.count_nonzero(decoded.triggers.edge))
            if len(decoded.t) == 0:
                continue
            if events == 0:
                first_us = int(decoded.t[0])
            last_us = int(decoded.t[-1])
            events += len(decoded.t)
            on += int(np.count_nonzero(decoded.p))
            windows, counts = np.unique(
                (decoded.t - first_us) // PEAK_WINDOW_US, return_counts=True
            )
            for window, count in zip(windows.tolist(), counts.tolist(), strict=True):
                busiest[window] = busiest.get(window, 0) + count
    seconds = (last_us - first_us) * 1e-6
    window_s = min(PEAK_WINDOW_US * 1e-6, seconds)
    peak = max(busiest.values(), default=0) / window_s if window_s else 0.0
    rows = {
        "format": f"EVT3, {header.width} x {header.height}",
        "events": f"{events:,} ({on:,} on, {events - on:,} off)",
        "time": f"{first_us * 1e-6:.6f} to {last_us * 1e-6:.6f} s ({seconds:.3f} s)",
        "mean rate": f"{events / seconds if seconds else 0.0:.4g} events/s",
        "peak rate": f"{peak:.4g} events/s in {PEAK_WINDOW_US // 1000} ms",
        "triggers": f"{triggers:,} ({rising:,} rising)",
    }
    rows |= {
        label: f"{value:,}"
        for name, value in asdict(decoder.counters).items()
        if value and (label := name.replace("_", " ")) not in rows
    }
    pairs(str(path), rows)
    known = Counter(events=events, decoder_gaps=gaps)
    faults = stream_faults(decoder_counts(decoder.counters) + known)
    for warning in [*reader.warnings, *faults]:
        warn(warning)
    return (first_us, last_us) if events else None
