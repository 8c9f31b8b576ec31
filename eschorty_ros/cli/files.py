"""Files and JSON on the command line, the same in every command."""

from __future__ import annotations

import datetime
from pathlib import Path

import click

IN_FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
OUT_FILE = click.Path(dir_okay=False, path_type=Path)
json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")


def report_replaced(path: Path) -> None:
    """Print which older result is replaced."""
    if path.is_file():
        made = datetime.datetime.fromtimestamp(path.stat().st_mtime)
        click.echo(f"{path} of {made:%Y-%m-%d %H:%M} is replaced", err=True)
