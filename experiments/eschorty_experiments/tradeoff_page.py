"""The table of docs/tradeoff.md, speed against error, made from the report's data.

Usage: python -m eschorty_experiments.tradeoff_page report/tradeoff-changes.csv docs/tradeoff.md
"""

from __future__ import annotations

import csv
import io
import sys
from collections.abc import Sequence
from pathlib import Path

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.base.files import atomic_write

BEGIN = "<!-- speed against error: made by `make tradeoff` -->"
END = "<!-- end of speed against error -->"

# Column of the data: heading, factor, decimals.
_COLUMNS = {
    "ns_per_event": ("ns per event", 1.0, 1),
    "us_per_profile": ("µs per profile", 1.0, 0),
    "times_baseline_speed": ("x baseline", 1.0, 1),
    "peak_MB": ("peak MB", 1.0, 0),
    "rmse_0_percent_mm": ("RMSE mm, 0 %", 1.0, 2),
    "rmse_5_percent_mm": ("5 %", 1.0, 2),
    "rmse_30_percent_mm": ("30 %", 1.0, 2),
    "gross_0_percent": ("gross %, 0 %", 100.0, 2),
    "gross_5_percent": ("5 %", 100.0, 2),
    "gross_30_percent": ("30 %", 100.0, 2),
    "completeness": ("complete %", 100.0, 2),
}


def markdown(table: str) -> str:
    """Return the Markdown table of the text of ``tradeoff-changes.csv``.

    Raises ``ArgumentError`` without rows, or when a column is missing.
    """
    rows = list(csv.DictReader(io.StringIO(table)))
    if not rows or not {"setting", *_COLUMNS} <= set(rows[0]):
        raise ArgumentError(
            "the data of the page's table lack rows or columns; "
            "give the file tradeoff-changes.csv of a report"
        )
    heads = ["setting", *(heading for heading, _, _ in _COLUMNS.values())]
    lines = ["| " + " | ".join(heads) + " |", "| --- |" + " ---: |" * len(_COLUMNS)]
    for row in rows:
        cells = [
            f"{factor * float(row[name]):.{decimals}f}"
            for name, (_, factor, decimals) in _COLUMNS.items()
        ]
        lines.append("| " + " | ".join([row["setting"], *cells]) + " |")
    return "\n".join(lines) + "\n"


def replaced(document: str, table: str) -> str:
    """Return ``document`` with ``table`` between the markers.

    Raises ``ArgumentError`` when it does not have each marker once, in order.
    """
    before, begin, rest = document.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end) or BEGIN in rest or END in after:
        raise ArgumentError(f"the document needs the lines {BEGIN!r} and {END!r} once, in order")
    return f"{before}{begin}\n\n{table}\n{end}{after}"


def main(arguments: Sequence[str]) -> None:
    """Replace the table in a page by that of a CSV file."""
    data, page = (Path(argument) for argument in arguments)
    text = replaced(page.read_text(), markdown(data.read_text()))
    with atomic_write(page) as stream:
        stream.write(text.encode())


if __name__ == "__main__":
    main(sys.argv[1:])
