"""Speed against error: what is compared, the front, and the page's table of it."""

import re
from pathlib import Path

import numpy as np
import pytest
from eschorty_experiments import tradeoff_page
from eschorty_experiments._tradeoff_runs import (
    BASELINE,
    SMOOTHING,
    Variant,
    one_change,
    peak_bytes,
    variants,
)
from eschorty_experiments._tradeoff_tables import pareto_front

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.line import CENTROIDS
from eschorty_ros.core.reconstruction import NOISE_FILTERS, Settings

ROOT = Path(__file__).resolve().parents[2]
SEED = 3


def test_every_estimator_filter_and_smoothing_is_compared_once():
    made = variants()
    assert (
        len(set(made)) == len(made) == 1 + len(CENTROIDS) * len(NOISE_FILTERS) * 2 * len(SMOOTHING)
    )
    assert {one.estimator for one in made} == {BASELINE, *CENTROIDS}
    assert sum(one.is_default for one in made) == 1
    assert {one.filters for one in made} >= {*NOISE_FILTERS, "gate"}
    assert len({one.label for one in made}) == len(made)


def test_one_change_at_a_time_starts_with_baseline_and_default():
    made = one_change()
    assert made[0] == Variant(None)
    assert made[1] == Variant(Settings())
    assert {one.estimator for one in made[1:]} == set(CENTROIDS)
    assert {one.half_width for one in made[1:]} == set(SMOOTHING)


def test_nothing_beats_the_front_and_the_front_beats_the_rest():
    points = [(3.0, 1.0), (1.0, 3.0), (2.0, 2.0), (2.0, 2.5), (4.0, 1.0), (1.0, 4.0)]
    assert pareto_front(points) == [1, 2, 0]
    cloud = np.random.default_rng(SEED).uniform(0.1, 10.0, (300, 2))
    front = pareto_front([(x, y) for x, y in cloud])
    for k, point in enumerate(cloud):
        beaten = np.any(np.all(cloud <= point, axis=1) & np.any(cloud < point, axis=1))
        assert beaten != (k in front), f"seed {SEED}"


def test_peak_memory_is_the_most_held_at_once():
    def task():
        first = np.zeros(1 << 20)
        del first
        return np.zeros(3 << 19)

    assert 12 << 20 <= peak_bytes(task) <= 13 << 20


def table_lines():
    text = (ROOT / "docs" / "tradeoff.md").read_text()
    table = text.partition(tradeoff_page.BEGIN)[2].partition(tradeoff_page.END)[0]
    return [line for line in table.splitlines() if line.startswith("|")]


def test_the_page_shows_the_settings_of_this_code():
    shown = [line.split("|")[1].strip() for line in table_lines()[2:]]
    expected = [variant.label for variant in one_change()]
    assert shown == expected, "run `make tradeoff`, for minutes: all its times change"
    assert all(len(line.split("|")) == len(table_lines()[0].split("|")) for line in table_lines())


def test_the_table_replaces_what_is_between_the_markers():
    heads = ["setting", *tradeoff_page._COLUMNS]
    data = ",".join(heads) + "\n" + ",".join(["one thing", *["0.123456"] * (len(heads) - 1)]) + "\n"
    table = tradeoff_page.markdown(data)
    assert re.search(r"^\| one thing \| 0\.1 \| 0 \| 0\.1 \|", table, re.MULTILINE)
    before = f"head\n{tradeoff_page.BEGIN}\nold\n{tradeoff_page.END}\ntail\n"
    after = tradeoff_page.replaced(before, table)
    assert "old" not in after
    assert after.startswith("head\n")
    assert after.endswith("tail\n")
    assert tradeoff_page.replaced(after, table) == after


@pytest.mark.parametrize("text", ["", tradeoff_page.BEGIN, tradeoff_page.END + tradeoff_page.BEGIN])
def test_a_document_without_markers_is_refused(text):
    with pytest.raises(ArgumentError, match="needs the lines"):
        tradeoff_page.replaced(text, "| |\n")


@pytest.mark.parametrize("text", ["", "setting,ns_per_event\na,1\n"])
def test_other_data_are_refused(text):
    with pytest.raises(ArgumentError, match=r"tradeoff-changes\.csv"):
        tradeoff_page.markdown(text)
