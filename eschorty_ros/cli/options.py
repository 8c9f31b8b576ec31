"""Options that several commands share."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import click

from eschorty_ros.core.optics import SHIPPED
from eschorty_ros.simulation.pixels import PRESETS
from eschorty_ros.simulation.scenes import NAMES

SWEEP_MAX_MM = 1000.0
"""Longer than any stage that scans; a recording of it would fill a disk."""
SPEED_MAX_MM_S = 1000.0
"""The fastest sweep of the scanner node."""


class _Bounded(click.types._NumberRangeBase):
    unit = ""
    """What follows the bounds in help and messages."""

    def _describe_range(self) -> str:
        if self.min is None and self.max is None:
            return ""
        return f"{super()._describe_range()} {self.unit}".rstrip()


class Integer(_Bounded, click.IntRange):
    """A whole number within bounds."""

    name = "integer"


class Number(_Bounded, click.FloatRange):
    """A finite number, within bounds if they are given."""

    name = "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the number; refuse NaN and infinity."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is not finite.", param, ctx)
        return number


_SWEEP = (
    click.option(
        "--scene",
        default="steps",
        show_default=True,
        help=f"{', '.join(NAMES)}, or a mesh in metres (needs open3d).",
    ),
    click.option(
        "--frequency",
        "frequency_hz",
        type=Number(16, 20_000),
        default=70.0,
        show_default=True,
        help="Modulation frequency, Hz; one profile per period, or per several where one has too "
        "few events.",
    ),
    click.option(
        "--speed",
        "speed_mm_s",
        type=Number(0, SPEED_MAX_MM_S, min_open=True),
        default=50.0,
        show_default=True,
        help="Stage speed, mm/s.",
    ),
    click.option(
        "--start",
        "start_mm",
        type=Number(),
        default=10.0,
        show_default=True,
        help="Stage position, mm.",
    ),
    click.option(
        "--stop",
        "stop_mm",
        type=Number(),
        default=110.0,
        show_default=True,
        help="Stage position, mm.",
    ),
    click.option(
        "--calibration",
        default="config_3",
        show_default=True,
        help=f"{', '.join(SHIPPED)}, or the path of a calibration.yaml.",
    ),
    click.option(
        "--pixels",
        type=click.Choice(tuple(PRESETS)),
        default="paper",
        show_default=True,
        help="Preset of the event pixels.",
    ),
    click.option(
        "--effects",
        default="none",
        show_default=True,
        metavar="NAME=VALUE,...",
        help="ambient, falloff_mm, defocus_mm, ghost and ghost_mm, occlusion, row_time_us: what "
        "the simulated world leaves out otherwise; docs/accuracy.md.",
    ),
    click.option("--seed", type=Integer(0), default=0, show_default=True, help="Noise seed."),
)


def sweep_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of scene, laser, stage, build, pixels, effects and seed to a command."""
    for option in reversed(_SWEEP):
        command = option(command)
    return command


def recorded_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that replace what a recording or a bag has, or lacks, to a command."""
    for option in (
        click.option(
            "--calibration",
            help=f"{', '.join(SHIPPED)}, or the path of a calibration.yaml.  "
            "[default: the recorded one]",
        ),
        click.option(
            "--frequency",
            type=Number(16, 20_000),
            help="Modulation frequency, Hz.  [default: the recorded one]",
        ),
        click.option(
            "--packet-period",
            type=Number(0, 100),
            default=4.0,
            show_default=True,
            help="For a bag without camera/clock: time over which the camera collects events "
            "before it sends them, ms.",
        ),
    ):
        command = option(command)
    return command


def stated(names: Iterable[str]) -> list[str]:
    """Return those options of the command that runs that stand on the command line."""
    source = click.get_current_context().get_parameter_source
    return [name for name in names if source(name) is not click.core.ParameterSource.DEFAULT]


def refuse_given(names: Iterable[str], reason: str) -> None:
    """Refuse options that stand on the command line without effect as wrong usage."""
    if without_effect := stated(names):
        raise click.UsageError(f"--{without_effect[0].replace('_', '-')} {reason}")


def check_sweep(start_mm: float, stop_mm: float) -> None:
    """Refuse a sweep without length as wrong usage."""
    if start_mm == stop_mm:
        raise click.UsageError(f"--start and --stop are both {start_mm:g} mm; give a distance")
    for name, value_mm in (("start", start_mm), ("stop", stop_mm)):
        if abs(value_mm) > SWEEP_MAX_MM:
            raise click.UsageError(f"--{name} is {value_mm:g} mm; choose up to {SWEEP_MAX_MM:g} mm")


def page_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the address of a page in the browser to a command."""
    port = click.option(
        "--port", type=Integer(1, 65535), default=8080, show_default=True,
        help="Port of the page.",
    )  # fmt: skip
    host = click.option(
        "--host", default="127.0.0.1", show_default=True,
        help="Address of the page; another one opens it to the network.",
    )  # fmt: skip
    return host(port(command))
