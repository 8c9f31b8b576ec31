"""The report as one HTML page beside its pictures and tables."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from eschorty_ros.core.base.files import atomic_write
from eschorty_ros.report.experiment import Finding
from eschorty_ros.report.sections import Section


def write_page(
    folder: Path, sections: Sequence[Section], made_with: Mapping[str, str], pending: int = 0
) -> Path:
    """Write ``index.html``; the pictures and tables that it links must exist.

    - ``folder``: Existing folder.
    - ``sections``: In the order of the page.
    - ``made_with``: Facts for the head of the page.
    - ``pending``: Experiments that have not run yet.

    Raises ``ArgumentError`` when the page cannot be written.
    """
    page = render(
        "page.html.jinja",
        title="Event-based Scheimpflug LiDAR: the report",
        sections=sections,
        made_with=made_with,
        pending=pending,
        findings=sum(len(section.findings) for section in sections),
        missed=[(section, finding) for section in sections for finding in section.missed],
        failed=[section for section in sections if section.failure],
        seconds=sum(section.seconds for section in sections),
    )
    path = folder / "index.html"
    with atomic_write(path) as stream:
        stream.write(page.encode())
    return path


def render(template: str, **values: Any) -> str:
    """Fill a template of this folder; text is escaped, a missing value an error."""
    environment = Environment(
        loader=PackageLoader("eschorty_ros.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {
        "number": number,
        "band": band,
        "reading": reading,
        "breakable": breakable,
    }
    return environment.get_template(template).render(**values)


def number(value: float | int | str) -> str:
    """Return a value as text: text as it is, whole numbers with all digits, else four or more.

    Values from 100 on keep two decimals, from a million on four digits and an exponent; the CSV
    file has every digit.
    """
    if isinstance(value, str):
        return value
    value = float(value)
    if math.isnan(value):
        return "n/a"
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    if value == int(value) and abs(value) < 1e12:
        text = f"{int(value):,}".replace(",", "\u202f")
    elif abs(value) >= 1e6 or abs(value) < 1e-4:
        text = f"{value:.3e}"
    elif abs(value) >= 100.0:
        text = f"{value:,.2f}".replace(",", "\u202f")
    else:
        text = f"{value:.4g}"
    return text


def breakable(name: str) -> Markup:
    """Return a name that may wrap after each underscore."""
    return Markup("_<wbr>").join(name.split("_"))


def reading(finding: Finding) -> str:
    """Return the value of a finding with its unit."""
    return f"{number(finding.value)} {finding.unit}".rstrip()


def band(finding: Finding) -> str:
    """Return the band of a finding in words."""
    low, high = number(finding.low), number(finding.high)
    if math.isinf(finding.low) and math.isinf(finding.high):
        return "any"
    if math.isinf(finding.low):
        return f"≤ {high}"
    if math.isinf(finding.high):
        return f"≥ {low}"
    return low if finding.low == finding.high else f"{low} to {high}"
