"""Files and JSON on the command line, the same in every command."""

from __future__ import annotations

from pathlib import Path

import click

IN_FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
OUT_FILE = click.Path(dir_okay=False, path_type=Path)
json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
