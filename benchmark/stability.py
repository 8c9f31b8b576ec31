"""Measured errors of the numerical hard cases, from the tests themselves.

Usage: python benchmark/stability.py [--write docs/numerics.md]

Runs test/stability and prints the largest error and the limit of each bound that the tests assert.
With --write the table replaces the one between the markers in that file.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
BEGIN, END = "<!-- measured: begin -->\n", "<!-- measured: end -->\n"


class Collector:
    """Collects the errors that the fixture ``measured`` recorded with each test."""

    def __init__(self) -> None:
        self.cases: dict[str, int] = {}
        self.tests: dict[int, int] = defaultdict(int)
        self.bounds: dict[tuple[int, str, float], float] = {}
        self.failed = 0

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        for item in items:
            marker = item.get_closest_marker("hard_case")
            if marker is not None:
                self.cases[item.nodeid] = marker.args[0]

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        case = self.cases.get(report.nodeid)
        self.failed += report.failed
        if report.when != "call" or case is None:
            return
        self.tests[case] += 1
        for kind, value in report.user_properties:
            if kind == "measured":
                what, error, limit = value
                key = case, what, limit
                self.bounds[key] = max(self.bounds.get(key, 0.0), error)

    def table(self) -> str:
        lines = [
            "| case | tests | bound asserted | largest error | limit |",
            "|---|---|---|---|---|",
        ]
        for case in sorted(self.tests):
            rows = [(what, e, limit) for (n, what, limit), e in self.bounds.items() if n == case]
            count = str(self.tests[case])
            for index, (what, error, limit) in enumerate(rows or [("true or false", None, None)]):
                name, tests = (str(case), count) if index == 0 else ("", "")
                lines.append(f"| {name} | {tests} | {what} | {text(error)} | {text(limit)} |")
        return "\n".join(lines) + "\n"


def text(value: float | None) -> str:
    if value is None:
        return "-"
    return "0" if value == 0.0 else f"{value:.2g}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", type=Path, help="file whose table is replaced")
    options = parser.parse_args()
    collector = Collector()
    arguments = [
        "-q",
        "-p",
        "no:cacheprovider",
        "--rootdir",
        str(ROOT),
        str(ROOT / "test/stability"),
    ]
    status = pytest.main(arguments, plugins=[collector])
    table = collector.table()
    print(table)
    if status == 0 and options.write:
        before, rest = options.write.read_text(encoding="utf-8").split(BEGIN)
        _, after = rest.split(END)
        options.write.write_text(f"{before}{BEGIN}{table}{END}{after}", encoding="utf-8")
    return int(status)


if __name__ == "__main__":
    sys.exit(main())
