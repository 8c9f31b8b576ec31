"""Files and JSON on the command line, the same in every command."""

from __future__ import annotations

import datetime
from pathlib import Path

import click

from eschorty_ros.core.base.errors import ArgumentError

IN_FILE = click.Path(exists=True, path_type=Path)
OUT_FILE = click.Path(dir_okay=False, path_type=Path)
json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")


def check_output(out: Path, *inputs: Path) -> None:
    """Refuse an output that cannot be written, or that would replace a cloud it is made of."""
    from eschorty_ros.core.base.files import check_writable

    if out.exists() and any(out.samefile(path) for path in inputs):
        raise ArgumentError(f"{out} is the cloud to read; choose another name for --out")
    check_writable(out)


def is_yaml(path: Path) -> bool:
    """Return whether a file is YAML by its name, such as a calibration."""
    return path.suffix.lower() in (".yaml", ".yml")


def check_picture(out: Path, *inputs: Path, others: tuple[str, ...] = ()) -> None:
    """Refuse a picture that cannot be written, or whose extension names no form of one.

    - ``others``: Extensions that the command also writes, for the message.
    """
    from matplotlib.backend_bases import FigureCanvasBase

    if out.suffix[1:].lower() not in FigureCanvasBase.get_supported_filetypes():
        known = ", ".join((*others, ".png", ".pdf"))
        raise ArgumentError(f"{out} ends in {out.suffix!r}; choose {known} or .svg")
    check_output(out, *inputs)


def report_replaced(*paths: Path) -> None:
    """Print which older results are replaced."""
    for path in filter(Path.is_file, paths):
        made = datetime.datetime.fromtimestamp(path.stat().st_mtime)
        click.echo(f"{path} of {made:%Y-%m-%d %H:%M} is replaced", err=True)
