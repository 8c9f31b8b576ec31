"""`eschorty report`: its page, its files, its exit codes; with small experiments made here."""

import csv
import re
from pathlib import Path

import eschorty_experiments as experiments
import html_check
import numpy as np
import pytest
from click.testing import CliRunner

from eschorty_ros.cli import main
from eschorty_ros.report.experiment import DataTable, Experiment, Finding, Outcome
from eschorty_ros.report.figures import new_figure
from eschorty_ros.report.page import band, number


def line_figure():
    figure = new_figure(4.0, 3.0)
    axes = figure.add_subplot()
    axes.plot([1, 2], [3, 5], label="measured")
    axes.set(xlabel="time (s)", ylabel="events", title="Growth")
    axes.legend()
    return figure


def good(effort, progress):
    progress(0.5, "half")
    return Outcome(
        findings=[Finding("slope", 2.0, 1.5, 2.5, "px"), Finding("share", 0.4, high=0.3)],
        tables={
            "shown": DataTable(["name", "value_mm"], [["a <b> & c", 1.0 / 3.0], ["d", -1e3]]),
            "hidden": DataTable(["x"], [[np.float64(0.1)], [np.int64(7)]], shown=False),
        },
        figures={"growth": line_figure()},
        captions={"growth": "Events over time.", "shown": "Two rows <i>.", "hidden": "Raw data."},
        remarks=[f"seed {effort.seed}, fast {effort.fast}", "1 < 2 & 3"],
    )


def bad(effort, progress):
    raise ValueError("row is -1\nchoose <0>")


def interrupted(effort, progress):
    raise KeyboardInterrupt


RUNS = {"good": good, "bad": bad, "interrupted": interrupted}


@pytest.fixture
def report(tmp_path, monkeypatch):
    """Runs the command over the named small experiments; gives result and folder."""

    def run(names, *arguments):
        monkeypatch.setattr("eschorty_ros.cli.report.NAMES", names)
        monkeypatch.setattr(
            experiments, "load", lambda name: Experiment(name, f"The {name} <one>", RUNS[name])
        )
        out = tmp_path / "deep" / "report"
        return CliRunner().invoke(main, ["report", "--out", str(out), *arguments]), out

    return run


def test_page_links_pictures_and_tables(report):
    result, out = report(("good",), "--seed", "5", "--fast")
    assert result.exit_code == 0, result.output
    page = out / "index.html"
    assert html_check.faults(page) == []
    made = {"index.html", "good-growth.png", "good-shown.csv", "good-hidden.csv"}
    assert {path.name for path in out.iterdir()} == made
    words = html_check.text(page)
    for part in ("The good <one>", "1.5 to 2.5", "✓ holds", "✗ missed", "≤ 0.3", "a <b> & c",
                 "Events over time.", "1 < 2 & 3", "seed 5, fast True", "fast: a coarse run",
                 "numba"):  # fmt: skip
        assert part in words, part
    assert "Growth: events over time (s) (measured)" in page.read_text()
    assert str(page) in result.stdout


def test_the_csv_has_every_digit(report):
    _, out = report(("good",))
    rows = list(csv.reader((out / "good-shown.csv").read_text().splitlines()))
    assert rows == [["name", "value_mm"], ["a <b> & c", repr(1.0 / 3.0)], ["d", "-1000.0"]]
    assert (out / "good-hidden.csv").read_text() == "x\n0.1\n7\n"


def test_a_missed_finding_is_a_result_and_is_listed(report):
    result, _ = report(("good",))
    assert result.exit_code == 0
    assert "missed: good: share is 0.4, band ≤ 0.3" in result.stdout
    assert "slope" not in result.stdout


def test_a_failure_keeps_the_others_and_is_exit_code_1(report):
    result, out = report(("bad", "good"))
    assert result.exit_code == 1
    assert result.stderr.count("eschorty: ") == 1
    assert "1 of 2 experiments failed, bad with ValueError: row is -1 choose <0>" in result.stderr
    assert html_check.faults(out / "index.html") == []
    words = html_check.text(out / "index.html")
    assert "This experiment failed. ValueError: row is -1 choose <0>" in words
    assert "in bad raise ValueError" in words
    assert (out / "good-growth.png").is_file()


def test_an_interrupted_report_keeps_what_is_done(report):
    result, out = report(("good", "interrupted", "bad"))
    assert result.exit_code == 130
    assert html_check.faults(out / "index.html") == []
    assert "2 experiments did not run" in html_check.text(out / "index.html")
    assert "good-growth.png" in (out / "index.html").read_text()


def test_only_runs_what_is_named_in_the_order_of_the_page(report, monkeypatch):
    names = experiments.NAMES
    assert len(names) == len(set(names))
    chosen = [names[-1], names[0]]
    for name in chosen:
        monkeypatch.setitem(RUNS, name, good)
    result, out = report(names, "--only", chosen[0], "--only", chosen[1])
    assert result.exit_code == 0, result.output
    words = html_check.text(out / "index.html")
    assert words.index(f"The {names[0]} <one>") <= words.index(f"The {names[-1]} <one>")
    assert not any(f"The {name} <one>" in words for name in names if name not in chosen)


def test_the_documentation_lists_every_experiment():
    text = (Path(__file__).parents[2] / "docs" / "report.md").read_text()
    documented = re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE)
    assert tuple(documented) == experiments.NAMES


def test_an_unknown_name_is_wrong_usage_and_names_the_choices(tmp_path):
    result = CliRunner().invoke(main, ["report", "--only", "nonsense", "--out", str(tmp_path)])
    assert result.exit_code == 2
    assert experiments.NAMES[0] in result.output
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_is_one_line(report, tmp_path):
    (tmp_path / "deep").write_text("a file")
    result, _ = report(("good",))
    assert (result.exit_code, result.stderr.count("\n")) == (1, 1)
    assert result.stderr.startswith("eschorty: ")


@pytest.mark.parametrize(
    ("value", "shown"),
    [(7, "7"), (-36510.29, "-36\u202f510.29"), (810.4502, "810.45"), (0.0123456, "0.01235"),
     (1280.0, "1\u202f280"), (3.2e-7, "3.200e-07"), (float("nan"), "n/a"), ("as is", "as is")],
)  # fmt: skip
def test_numbers_read_well(value, shown):
    assert number(value) == shown


@pytest.mark.parametrize(
    ("low", "high", "words"),
    [(1.0, 2.0, "1 to 2"), (2.0, 2.0, "2"), (-np.inf, 2.0, "≤ 2"), (1.0, np.inf, "≥ 1")],
)
def test_bands_read_well(low, high, words):
    assert band(Finding("x", 1.0, low, high)) == words


def test_nan_is_outside_every_band():
    assert not Finding("x", float("nan")).holds
