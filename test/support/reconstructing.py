"""Streams reconstructed at once or in pieces; every event is in one of the counters."""

from collections.abc import Iterable
from dataclasses import fields
from itertools import pairwise

import numpy as np

from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import Calibration, load_calibration
from eschorty_ros.core.reconstruction import Profiles, Reconstructor, Settings

KNOWN = Modulation(70.0, on_edge_us=1000)
CALIBRATION = load_calibration("config_3")
EVENTS_GO_TO = (
    "events_binned", "events_over_column_limit", "events_outside_phase", "events_filtered",
    "events_gated", "events_held", "events_outside_roi",
)  # fmt: skip


def reconstruct(
    data: bytes,
    modulation: Modulation = KNOWN,
    settings: Settings | None = None,
    cuts: Iterable[int] = (),
    calibration: Calibration = CALIBRATION,
) -> tuple[Profiles, Reconstructor]:
    """Return the profiles of ``data``, pushed in pieces that end at ``cuts``."""
    reconstructor = Reconstructor(calibration, modulation, settings)
    limits = [0, *sorted(cuts), len(data)]
    parts = [reconstructor.push(data[begin:end]) for begin, end in pairwise(limits)]
    found = Profiles.concatenate([*parts, reconstructor.flush()])
    assert_events_add_up(reconstructor)
    assert reconstructor.counters["events_held"] == 0
    return found, reconstructor


def assert_events_add_up(reconstructor: Reconstructor) -> None:
    counts = reconstructor.counters
    assert counts["events"] == sum(counts[name] for name in EVENTS_GO_TO), counts


def assert_same(a: Profiles, b: Profiles) -> None:
    for item in fields(Profiles):
        np.testing.assert_array_equal(getattr(a, item.name), getattr(b, item.name), item.name)
