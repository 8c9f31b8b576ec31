"""Every experiment of the report, run fast: each finding lies in its band."""

import re

import pytest
from eschorty_experiments import NAMES, load

from eschorty_ros.report.experiment import Effort

SEED = 1


@pytest.mark.parametrize("name", NAMES)
def test_findings_hold(name):
    experiment = load(name)
    assert experiment.name == name
    shares = []
    outcome = experiment.run(Effort(fast=True, seed=SEED), lambda share, note: shares.append(share))
    assert shares == sorted(shares)
    stems = [*outcome.figures, *outcome.tables]
    assert all(re.fullmatch(r"\w+", stem) for stem in stems), stems
    assert set(stems) <= set(outcome.captions), "a figure or table has no caption"
    for table in outcome.tables.values():
        assert all(len(row) == len(table.columns) for row in table.rows)
    assert outcome.findings
    names = [finding.name for finding in outcome.findings]
    assert len(names) == len(set(names)), "two findings share a name"
    missed = [finding for finding in outcome.findings if not finding.holds]
    assert not missed, f"seed {SEED}: {missed}"


def test_post_that_appears_in_a_farther_row_has_a_longer_range():
    table = load("range_curves").run(Effort(fast=True, seed=SEED), lambda *_: None).tables["posts"]
    row, range_ = (table.columns.index(f"residual_{unit}") for unit in ("px", "mm"))
    assert all(line[row] * line[range_] > 0.0 for line in table.rows)
