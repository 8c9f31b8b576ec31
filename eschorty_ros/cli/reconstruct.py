"""`eschorty reconstruct`."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from eschorty_ros.cli.cluster import on_cluster
from eschorty_ros.cli.console import accuracy_rows, of_total, pairs, progress_bar, warn
from eschorty_ros.cli.convert import recording_of
from eschorty_ros.cli.files import OUT_FILE, json_option, report_replaced
from eschorty_ros.cli.options import Integer, Number, recorded_options, refuse_given, stated
from eschorty_ros.core.base.errors import EschortyError

if TYPE_CHECKING:
    from eschorty_ros.core.base.progress import Progress
    from eschorty_ros.core.reconstruction import Result
    from eschorty_ros.core.storage import Recording
    from eschorty_ros.report.accuracy import Accuracy


class SettingsCommand(click.Command):
    """A command with one option per reconstruction setting, read from the settings themselves."""

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """Return the options of the command and of the settings."""
        return [*super().get_params(ctx), *setting_options()]


def setting_options() -> list[click.Parameter]:
    """Return one click option per field of `Settings`."""
    from eschorty_ros.core.reconstruction import Settings

    options: list[click.Parameter] = []
    for item in fields(Settings):
        meta = item.metadata
        kind: click.Choice[str] | Integer | Number
        if "choices" in meta:
            kind = click.Choice(meta["choices"])
        else:
            low, high = meta["range"]
            whole = isinstance(item.default, int)
            kind = Integer(int(low), int(high)) if whole else Number(low, high)
            kind.unit = meta["unit"]
        options.append(
            click.Option(
                [f"--{item.name.replace('_', '-')}", item.name],
                type=kind,
                default=item.default,
                show_default=True,
                help=meta["description"],
            )
        )
    return options


@click.command("reconstruct", cls=SettingsCommand)
@click.argument(
    "recordings",
    metavar="RECORDING...",
    nargs=-1,
    required=True,
    type=click.Path(path_type=Path),
)
@click.option(
    "--out",
    type=OUT_FILE,
    help="Cloud to write, .pcd or .ply, of one recording.  [default: RECORDING/cloud.pcd]",
)
@click.option("--jobs", type=Integer(1, 256), help="Threads.  [default: one per core]")
@click.option(
    "--dask",
    metavar="ADDRESS",
    help="Reconstruct on the cluster of this dask scheduler, one task a recording.",
)
@recorded_options
@json_option
def command(
    recordings: tuple[Path, ...],
    out: Path | None,
    jobs: int | None,
    dask: str | None,
    as_json: bool,
    frequency: float | None,
    calibration: str | None,
    packet_period: float,
    **settings: Any,
) -> None:
    """Turn each RECORDING, a folder or a rosbag2, into a point cloud.

    The cloud is in eschorty_base, in metres: x y z, intensity (events used), sigma (one sigma of
    the range), t (seconds since the first event), column, flags (1: on two surfaces, 2: cut by the
    sensor's edge, 4: few events; 0: good); with --reflectance on also reflectance and
    reflectance_sigma.

    The settings are those of the recorded scan, or the defaults, where no option is given.

    A cloud without points is not written: exit code 1, with the reason. Of several recordings one
    that fails does not end the others.

    \b
    --json prints events, dropped_events, profiles, periods_per_profile, points, seconds,
    events_per_second, sigma_median_m (null when there is no point), warnings,
    points_without_stage and counters (those that are not zero); for a recording with truth.csv
    also score: periods, points, completeness, error_median_mm, error_p95_mm, bias_mm,
    within_1_sigma, within_2_sigma, off_target (points where nothing is), flagged, and
    good_median_mm, good_p95_mm, good_within_1_sigma and good_within_2_sigma of the points without a
    flag; without those that no point gives. Where passes back and forth show a lag, pass_lag_ms has
    it and its sigma. Of several recordings it prints one object a line, with recording first, and
    error alone where it failed.

    \b
    Examples:
      eschorty reconstruct rec
      eschorty reconstruct rec --out rec.ply --centroid median
      eschorty reconstruct rec --calibration built.yaml
      eschorty reconstruct rec --json --smoothing-half-width 0
      eschorty reconstruct bag.mcap --frequency 70 --calibration my.yaml
      eschorty reconstruct monday/* --dask tcp://host:8786
    """  # noqa: D301
    refuse_given(["stage_speed_mm_s"], "is for the node; a recording's own speed is used")
    calls = _calls(recordings, out)
    task = partial(
        reconstruct_to,
        jobs=jobs,
        given={name: settings[name] for name in stated(settings)},
        frequency=frequency,
        calibration=calibration,
        packet_period_ms=packet_period,
        show=dask is None,
    )
    several = len(calls) > 1
    failed: dict[Path, Exception] = {}
    for index, done in _here(task, calls) if dask is None else on_cluster(dask, task, calls):
        error = _printed(done, *calls[index], several, as_json)
        if error is not None:
            failed[recordings[index]] = error
    if failed and not several:
        raise failed[recordings[0]]
    if failed:
        raise EschortyError(
            f"{len(failed)} of {len(recordings)} recordings failed; see the lines above"
        )


def _calls(recordings: tuple[Path, ...], out: Path | None) -> list[tuple[Path, Path]]:
    """Return each recording with its cloud; refuse those that cannot be as wrong usage."""
    from eschorty_ros.core.storage import RAW_ALONE, is_cloud
    from eschorty_ros.live.bag_files import is_bag

    if len(recordings) > 1 and out is not None:
        raise click.BadParameter(f"one file for {len(recordings)} recordings", param_hint="--out")
    for recording in recordings:
        if is_bag(recording):
            continue
        if recording.is_file():
            raise click.BadParameter(
                f"{recording} is a file; give a recording's folder or a bag; {RAW_ALONE}"
            )
        refuse_given(["packet_period"], f"is for a bag; {recording} is none")
    if out is not None and not is_cloud(out):
        raise click.BadParameter(f"{out} ends in neither .pcd nor .ply", param_hint="--out")
    targets = [out or _target(recording) for recording in recordings]
    for target in targets:
        if targets.count(target) > 1:
            raise click.UsageError(
                f"two recordings would be written to {target}; give them one by one"
            )
    return list(zip(recordings, targets, strict=True))


def _printed(
    done: Any, recording: Path, target: Path, several: bool, as_json: bool
) -> Exception | None:
    """Print what a recording gave; return its error, printed, too, where there are several."""
    error = done if isinstance(done, Exception) else None
    if error is None:
        facts, measured = done
        _print(facts, measured, target, recording if several else None, as_json)
        if not facts["points"]:
            error = EschortyError(f"{recording} gives no points; {target} is not written")
    elif as_json and several:
        click.echo(json.dumps({"recording": str(recording), "error": str(error)}))
    if error is not None and several:
        click.echo(f"eschorty: {recording}: {error or type(error).__name__}", err=True)
    return error


def _target(recording: Path) -> Path:
    """Return where the cloud of a recording, a folder or a bag, is written."""
    if recording.is_dir():
        return recording / "cloud.pcd"
    return recording.with_suffix(".pcd")


def _here(
    task: Callable[[Path, Path], Any], calls: list[tuple[Path, Path]]
) -> Iterator[tuple[int, Any]]:
    """Yield the index and the result of each call of ``task``, or its error."""
    for index, call in enumerate(calls):
        try:
            yield index, task(*call)
        except (EschortyError, OSError) as error:
            yield index, error


def reconstruct_to(
    recording: Path,
    target: Path,
    *,
    jobs: int | None,
    given: dict[str, Any],
    frequency: float | None,
    calibration: str | None,
    packet_period_ms: float,
    show: bool,
) -> tuple[dict[str, Any], Accuracy | None]:
    """Write the cloud of a recording, if it has points; return its summary and its errors.

    With ``show`` the progress is printed.
    """
    from eschorty_ros.core.base.files import check_writable, temporary_folder
    from eschorty_ros.core.optics import load_calibration
    from eschorty_ros.core.storage import load_recording
    from eschorty_ros.live.bag_files import is_bag

    check_writable(target)
    if not is_bag(recording):
        build = None if calibration is None else load_calibration(calibration)
        loaded = load_recording(recording, build, frequency)
        return _reconstruct(loaded, target, jobs, given, show)
    with temporary_folder() as made:
        folder = made / recording.stem
        with _progress("reading the bag", show):
            recording_of(recording, folder, frequency, calibration, packet_period_ms, given)
        return _reconstruct(load_recording(folder), target, jobs, given, show)


def _progress(title: str, show: bool) -> AbstractContextManager[Progress]:
    return progress_bar(title) if show else nullcontext(lambda share, note: None)


def _reconstruct(
    loaded: Recording, target: Path, jobs: int | None, given: dict[str, Any], show: bool
) -> tuple[dict[str, Any], Accuracy | None]:
    """Write the cloud of ``loaded``; return as `reconstruct_to`."""
    from eschorty_ros.core.base.files import folder_beside
    from eschorty_ros.core.reconstruction import (
        reconstruct_recording,
        recorded_settings,
        warm_up,
    )
    from eschorty_ros.core.storage import write_cloud
    from eschorty_ros.report.accuracy import measure_recorded

    chosen = replace(recorded_settings(loaded), **given)
    chosen.check_effect(given)
    with _progress("reconstructing", show) as report, folder_beside(target) as folder:
        report(0.0, "compiling, first run only")
        warm_up(loaded.calibration, chosen)
        result = reconstruct_recording(loaded, chosen, of_total(report), jobs, folder)
        report(1.0, "scoring and writing")
        measured = measure_recorded(result.points, result.profiles, loaded)
        if len(result.points):
            report_replaced(target)
            write_cloud(target, result.points if result.organized is None else result.organized)
        return summary(result), measured


def _print(
    facts: dict[str, Any],
    measured: Accuracy | None,
    target: Path,
    recording: Path | None,
    as_json: bool,
) -> None:
    """Print what is known of a cloud; the recording is named where there are several."""
    from eschorty_ros.core.reconstruction import PassLag

    name = "" if recording is None else f"{recording}: "
    for warning in facts["warnings"]:
        warn(f"{name}{warning}")
    if as_json:
        first = {} if recording is None else {"recording": str(recording)}
        if measured is not None:
            known = {name: value for name, value in asdict(measured).items() if value == value}
            facts = {**facts, "score": known}
        click.echo(json.dumps({**first, **facts}))
    if as_json or not facts["points"]:
        return
    sigma, lag_ms = facts["sigma_median_m"], facts.get("pass_lag_ms")
    outside = facts["counters"].get("points_outside_scan")
    lag = None if lag_ms is None else PassLag(*(1e3 * ms for ms in lag_ms))
    pairs(
        str(target),
        {
            "events": f"{facts['events']:,}",
            "events dropped": f"{facts['dropped_events']:,}",
            "profiles": f"{facts['profiles']:,}",
            "periods per profile": f"{facts['periods_per_profile']}",
            "points": f"{facts['points']:,}",
            **({"points outside the scan": f"{outside:,}"} if outside else {}),
            "median sigma": "none" if sigma is None else f"{sigma * 1e3:.3f} mm",
            **({} if lag is None else {"lag taken off": str(lag)}),
            "seconds": f"{facts['seconds']:.2f}",
            "events/s": f"{facts['events_per_second']:.3g}",
            **({} if measured is None else accuracy_rows(measured)),
        },
    )


def summary(result: Result) -> dict[str, Any]:
    """Return the keys of ``--json`` for a reconstruction's result."""
    import numpy as np

    points = result.points
    return {
        "events": result.events,
        "dropped_events": result.counters["events_over_column_limit"],
        "profiles": result.profile_count,
        "periods_per_profile": result.periods_per_profile,
        "points": len(points),
        "seconds": result.seconds,
        "events_per_second": result.events_per_second,
        "sigma_median_m": float(np.median(points["sigma"])) if len(points) else None,
        "warnings": list(result.warnings),
        "points_without_stage": result.counters["points_without_stage"],
        "counters": {name: count for name, count in result.counters.items() if count},
        **({"pass_lag_ms": [1e-3 * us for us in result.pass_lag]} if result.pass_lag else {}),
    }
