"""Writes the tables of docs/faults.md: what a plan can name, and how the drivers take each fault.

Every test named test_fault_<id>_<what> is a row; its docstring says what the driver does and what
the user reads, its outcome is the result. Usage: python test/fault_table.py (or make faults).
"""

from __future__ import annotations

import ast
import re
import sys
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from eschorty_ros.emulation.fault_catalogue import CATALOGUE

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "faults.md"
FAULTS = {
    "u1": "USB unplugged",
    "u2": "endpoint stalls",
    "u3": "no answer, time-out",
    "u4": "malformed transfer",
    "u5": "partial reply",
    "u6": "stale reply",
    "u7": "error queue",
    "u8": "setting clamped or ignored",
    "u9": "generator rebooted",
    "u10": "no permission, busy",
    "s1": "garbage between frames",
    "s2": "bytes lost",
    "s3": "bit flips",
    "s4": "encoder jumps",
    "s5": "carriage stalls",
    "s6": "serial unplugged, silent",
    "s7": "limit switch",
    "s8": "completion message missing",
    "s9": "keep-alive missing",
    "s10": "disabled, not homed, move ignored",
    "s11": "controller reports an error",
    "s12": "controller rebooted",
    "s13": "late or double reply",
    "x1": "host stalls",
    "x2": "two clients",
    "x3": "shutdown at any time",
}
_NAME = re.compile(r"test_fault_([usx]\d+)_(\w+)")
_SAYS = re.compile(r"driver: (?P<driver>.+?)[;.] user reads: (?P<user>.+?\.\.\.|.+?)\.?$", re.S)


@dataclass(frozen=True)
class FaultTest:
    """One test of a fault."""

    file: str
    name: str
    driver: str
    user: str

    @property
    def id(self) -> str:
        return _NAME.fullmatch(self.name)[1]


@dataclass
class Outcomes:
    """Results by file and test function."""

    passed: dict[tuple[str, str], int] = field(default_factory=lambda: defaultdict(int))
    failed: dict[tuple[str, str], int] = field(default_factory=lambda: defaultdict(int))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Count; pytest calls this for every phase of every test."""
        file, _, rest = report.nodeid.partition("::")
        key = file, rest.split("[")[0].split("::")[-1]
        if report.failed:
            self.failed[key] += 1
        elif report.when == "call" and report.passed:
            self.passed[key] += 1

    def text(self, test: FaultTest) -> str:
        passed, failed = (counts[test.file, test.name] for counts in (self.passed, self.failed))
        if failed:
            return f"**{failed} failed**"
        return f"{passed} passed" if passed else "**not run**"


def fault_tests() -> list[FaultTest]:
    """Every test of a fault, by reading the files; sorted by id."""
    found = []
    for path in sorted((ROOT / "test").rglob("test_*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef) and _NAME.fullmatch(node.name):
                says = _SAYS.match(" ".join((ast.get_docstring(node) or "").split()))
                driver, user = (says["driver"], says["user"]) if says else ("", "")
                file = str(path.relative_to(ROOT))
                found.append(FaultTest(file, node.name, driver, user))
    order = list(FAULTS)
    return sorted(found, key=lambda t: (order.index(t.id), t.file, t.name))


def result_rows(tests: list[FaultTest]) -> list[tuple[str, FaultTest]]:
    """Begin of each test's row, up to the result."""
    rows = []
    for test in tests:
        case = f"{_NAME.fullmatch(test.name)[2]} ({Path(test.file).stem.removeprefix('test_')})"
        cells = (f"{test.id.upper()} {FAULTS[test.id]}", case, test.driver, test.user)
        rows.append(("| " + " | ".join(map(_cell, cells)) + " |", test))
    return rows


def catalogue_table() -> str:
    """What plans can name."""
    lines = ["| device | fault | of | what happens | ends |", "| --- | --- | --- | --- | --- |"]
    for device, kinds in CATALOGUE.items():
        for name, kind in kinds.items():
            ends = "with `for_s`" if kind.end else "by itself"
            lines.append(f"| {device} | `{name}` | {kind.id} | {_cell(kind.means)} | {ends} |")
    return "\n".join(lines) + "\n"


def result_table(tests: list[FaultTest], outcomes: Outcomes) -> str:
    """What the drivers do about each fault, and whether the tests say so."""
    lines = ["| fault | case | driver | user reads | result |", "| --- | --- | --- | --- | --- |"]
    lines += [f"{row} {outcomes.text(test)} |" for row, test in result_rows(tests)]
    return "\n".join(lines) + "\n"


def replaced(page: str, name: str, table: str) -> str:
    """``page`` with the table between the marks of that name."""
    begin, end = f"<!-- {name}: made by `make faults` -->\n", f"<!-- end of {name} -->"
    head, rest = page.split(begin)
    return head + begin + "\n" + table + "\n" + end + rest.split(end)[1]


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def main() -> int:
    """Run the fault tests and write the page."""
    tests, outcomes = fault_tests(), Outcomes()
    files = sorted({str(ROOT / test.file) for test in tests})
    code = pytest.main(["-q", "-k", "test_fault_", *files], plugins=[outcomes])
    page = replaced(PAGE.read_text(encoding="utf-8"), "catalogue", catalogue_table())
    page = replaced(page, "results", result_table(tests, outcomes))
    PAGE.write_text(page, encoding="utf-8")
    return int(code)


if __name__ == "__main__":
    sys.exit(main())
