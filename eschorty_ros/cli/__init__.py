"""The command `eschorty`."""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import signal
import sys
from collections.abc import Iterator
from typing import Any, NoReturn

import click

from eschorty_ros import __version__
from eschorty_ros.core.base.errors import EschortyError

COMMANDS = {
    "scan": "Scan a simulated scene through the ROS 2 nodes; cloud, picture and error.",
    "simulate": "Simulate a recording with its truth; needs no ROS.",
    "reconstruct": "Turn a recording into a point cloud; needs no ROS.",
    "convert": "Make a rosbag2 of a recording, or a recording of a rosbag2; needs no ROS.",
    "calibrate": "Fit a build to targets at known ranges; a calibration and a page about it.",
    "view": "Draw a cloud, or show it or the instrument in the browser.",
    "measure": "Measure planes in a cloud: flatness, distance, step, gap and flush.",
    "mesh": "Make a triangle mesh of a cloud, decimated to the points' errors.",
    "register": "Join clouds of several passes or poses in one frame.",
    "info": "Show the content of a file or recording.",
    "report": "Rerun the experiments; a page of figures, tables and findings.",
    "compile": "Compile the numerical kernels before the first run.",
    "design": "Tabulate range, sampling and depth of field of an optical build.",
}
INTERRUPTED = 130


class StatedFailure(click.ClickException):
    """A failure with its one line; exit code 1."""

    def show(self, file: Any = None) -> None:
        """Write the line to stderr."""
        click.echo(f"eschorty: {self.format_message()}", err=True)


class LazyGroup(click.Group):
    """Imports a command's module when the command runs, so that ``--help`` answers at once."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the command names in the order of first use."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return the command of that name, ``None`` when there is none."""
        if cmd_name not in COMMANDS:
            return None
        module = importlib.import_module(f"eschorty_ros.cli.{cmd_name}")
        command: click.Command = module.command
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl(list(COMMANDS.items()))

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command; an error of the package becomes one line, a signal 128 and its number."""
        _open_closed_streams()
        # A terminal without a degree sign gets a question mark.
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, io.TextIOWrapper):
                stream.reconfigure(errors="replace")
        with _stated_failures():
            try:
                with _ended_by_signals():
                    return super().invoke(ctx)
            except KeyboardInterrupt:
                click.echo("eschorty: interrupted", err=True)
                ctx.exit(INTERRUPTED)

    def make_context(self, *args: Any, **extra: Any) -> click.Context:
        """Read the arguments; ``--help`` and ``--version`` print here."""
        with _stated_failures():
            return super().make_context(*args, **extra)


@contextlib.contextmanager
def _stated_failures() -> Iterator[None]:
    """Turn the errors of the package, of files and of memory into one line."""
    try:
        yield
    except EschortyError as error:
        raise StatedFailure(str(error)) from error
    except BrokenPipeError:
        # The reader of the output closed it; click ends without a message.
        raise
    except OSError as error:
        _drop_unprinted()
        raise StatedFailure(_unusable(error)) from error
    except MemoryError as error:
        raise StatedFailure(f"not enough memory: {error}; end other programs") from error


def _drop_unprinted() -> None:
    """Drop what a full disk does not take, on which Python would fail again when it ends."""
    try:
        sys.stdout.flush()
    except OSError:
        with open(os.devnull, "w") as nothing:
            os.dup2(nothing.fileno(), sys.stdout.fileno())


def _open_closed_streams() -> None:
    """Open streams that the process was started without, as by ``>&-``: what is printed is dropped.

    Else files of the command would take their numbers, and what libraries print.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115 - the process's


@contextlib.contextmanager
def _ended_by_signals() -> Iterator[None]:
    """Make SIGTERM, SIGHUP and SIGINT raise, so that every clean-up runs and the laser is disabled.

    A shell starts a background job with SIGINT ignored. ``nohup`` ignores SIGHUP, and the command
    goes on.
    """
    handlers: dict[int, Any] = {
        signal.SIGINT: signal.default_int_handler,
        signal.SIGTERM: _terminated,
        signal.SIGHUP: _terminated,
    }
    if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:
        del handlers[signal.SIGHUP]
    previous = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _terminated(number: int, _: object) -> NoReturn:
    sys.exit(128 + number)


def _unusable(error: OSError) -> str:
    """Return one line that names the file and the reason."""
    if error.filename is None:
        return f"cannot continue: {error.strerror or error}; check disk and output"
    return f"cannot use {error.filename}: {error.strerror}; check the path"


@click.group(
    cls=LazyGroup,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(__version__)
def main() -> None:
    """Event-based Scheimpflug LiDAR: simulate, scan, reconstruct, view.

    A camera on a tilted sensor plane watches a modulated laser line while a stage carries it past
    the scene; every modulation period becomes one profile of 3D points. Ranges are along the
    laser sheet. Lengths are in mm unless an option has another unit; clouds hold metres.

    \b
    A recording is a folder:
      events.raw        the camera's bytes, Prophesee RAW with EVT3
      stage.csv         t_us,position_mm in the sensor's time
      laser.yaml        frequency_hz, duty, waveform, on_edge_us
      calibration.yaml  the optical build
      truth.csv         simulated only: t_us,column,range_mm

    \b
    Examples:
      eschorty scan --scene steps --out scan
      eschorty simulate --scene sphere --out rec
      eschorty reconstruct rec --out rec/cloud.pcd
      eschorty view rec/cloud.pcd
    """  # noqa: D301
