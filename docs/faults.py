"""Writes the table of docs/faults.md: what the drivers do about each fault and what users read.

Every test with ``@pytest.mark.fault("<fault>")`` is a row, with a docstring
``driver: <what it does>; user reads: <what the user reads>``.
Usage: python docs/faults.py (or make faults).
"""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
PAGE = Path(__file__).with_suffix(".md")
FAULTS = (
    "USB unplugged",
    "endpoint stalls",
    "no answer, time-out",
    "malformed transfer",
    "partial reply",
    "stale reply",
    "error queue",
    "setting clamped or ignored",
    "generator rebooted",
    "no permission, busy",
    "garbage between frames",
    "bytes lost",
    "bit flips",
    "encoder jumps",
    "carriage stalls",
    "serial line unplugged, no answer",
    "limit switch",
    "completion message missing",
    "keep-alive missing",
    "disabled, not homed, move ignored",
    "controller reports an error",
    "controller rebooted",
    "late or double reply",
    "host stalls",
    "two clients",
    "shutdown at any time",
)
_BEGIN, _END = "<!-- made by `make faults` -->\n\n", "\n<!-- end -->"
_DOCSTRING = re.compile(r"driver: (?P<driver>.+?)[;.] user reads: (?P<user>.+?\.\.\.|.+?)\.?$")


class FaultTest(NamedTuple):
    """One test of a fault, a row of the table."""

    fault: str
    case: str
    file: str
    driver: str
    user: str


def fault_tests() -> list[FaultTest]:
    """Return every test of a fault, from the files, in the order of ``FAULTS``."""
    found = []
    for path in sorted((ROOT / "test").rglob("test_*.py")):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.FunctionDef) and (fault := _fault_of(node)):
                case = node.name.removeprefix("test_").replace("_", " ")
                match = _DOCSTRING.match(" ".join((ast.get_docstring(node) or "").split()))
                driver, user = match.groups() if match else ("", "")
                found.append(FaultTest(fault, case, path.name, driver, user))
    return sorted(found, key=lambda test: FAULTS.index(test.fault))


def _fault_of(node: ast.FunctionDef) -> str:
    for decorator in node.decorator_list:
        if isinstance(decorator, ast.Call) and ast.unparse(decorator.func) == "pytest.mark.fault":
            return str(ast.literal_eval(decorator.args[0]))
    return ""


def page() -> str:
    """Return the page with the table of the present tests."""
    head, _, rest = PAGE.read_text(encoding="utf-8").partition(_BEGIN)
    _, _, tail = rest.partition(_END)
    lines = ["| fault | case | test | driver | user reads |", "| --- | --- | --- | --- | --- |"]
    lines += ["| " + " | ".join(c.replace("|", "\\|") for c in t) + " |" for t in fault_tests()]
    return head + _BEGIN + "\n".join(lines) + "\n" + _END + tail


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
