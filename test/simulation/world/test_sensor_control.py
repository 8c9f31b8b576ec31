"""Biases and event rate of a world that runs: what changes, when, and what goes on."""

import random
from dataclasses import replace

import numpy as np
import pytest

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.clocks import plan_move
from eschorty_ros.core.evt3 import Decoder
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.simulation.pixels import Biases, PixelArray, PixelParameters, preset
from eschorty_ros.simulation.readout import EventRate
from eschorty_ros.simulation.scenes import Plane
from eschorty_ros.simulation.world import SensorControl, World

SEED = 12
QUIET = PixelParameters(threshold_mismatch=0.0, noise=0.0, latency_jitter_us=0.0)
SMALL = replace(load_calibration("config_3"), columns=64, principal_column=None)


def world(frequency_hz: float = 500.0, preset_name: str = "paper") -> World:
    """A plane that comes nearer."""
    made = World(Plane(1320.0, slope_stage=1.0), SMALL, preset(preset_name), SEED)
    made.set_laser(0, True, Modulation(frequency_hz, on_edge_us=0))
    made.set_stage(plan_move(0, 10.0, 60.0, 100.0, 2000.0))
    return made


def events_between(made: World, begin_us: int, end_us: int) -> int:
    """Events of a stretch of time still to come."""
    made.advance(begin_us)
    begun = made.events
    made.advance(end_us)
    return made.events - begun


def controlled(preset_name: str = "paper") -> World:
    """A world whose settings change in all kinds of moments."""
    made = world(preset_name=preset_name)
    for t_us, control in (
        (20_000, SensorControl(Biases(diff_on=40, fo=-10))),
        (41_003, SensorControl(Biases(diff_on=-60, fo=-10))),
        (41_777, SensorControl(Biases(fo=-10, refr=50), EventRate(80, 200))),
        (70_011, SensorControl(event_rate=EventRate(100, 150))),
        (90_500, SensorControl(Biases(diff_off=100))),
        (110_000, SensorControl()),
    ):
        made.set_sensor(t_us, control)
    return made


def test_factory_settings_change_nothing():
    controlled_world = world()
    controlled_world.set_sensor(0, SensorControl())
    controlled_world.set_sensor(30_001, SensorControl())
    assert controlled_world.advance(60_000) == world().advance(60_000)


@pytest.mark.parametrize("preset_name", ["paper", "noisy", "ideal"])
def test_bytes_do_not_depend_on_how_time_is_cut(preset_name):
    print(f"seed {SEED}")
    uncut = controlled(preset_name)
    expected = uncut.advance(140_000)
    assert uncut.rate_dropped > 100
    rng = random.Random(SEED)
    for longest_us in (300, 30_000):
        cut = controlled(preset_name)
        parts = []
        while cut.now_us < 140_000:
            parts.append(cut.advance(min(cut.now_us + rng.randint(0, longest_us), 140_000)))
        assert b"".join(parts) == expected


def test_nothing_changes_before_its_time():
    changed, plain = world(), world()
    changed.set_sensor(50_000, SensorControl(Biases(diff_on=100)))
    assert changed.advance(50_000) == plain.advance(50_000)
    changed.advance(100_000)
    plain.advance(100_000)
    assert changed.events < 0.97 * plain.events


@pytest.mark.parametrize(
    ("biases", "frequency_hz"),
    [
        (Biases(diff_on=110), 500.0),
        (Biases(diff_on=-30, diff_off=-20), 500.0),
        (Biases(fo=-25), 5000.0),
        (Biases(refr=120), 2000.0),
    ],
)
def test_a_changed_world_becomes_one_that_was_always_so(biases, frequency_hz):
    print(f"seed {SEED}")
    span_us = round(100e6 / frequency_hz)
    before, always, changed = world(frequency_hz), world(frequency_hz), world(frequency_hz)
    always.set_sensor(0, SensorControl(biases))
    changed.set_sensor(10_123, SensorControl(biases))
    counts = [events_between(one, 30_000, 30_000 + span_us) for one in (before, always, changed)]
    print(biases, counts)
    assert counts[2] == pytest.approx(counts[1], rel=0.01)
    assert abs(counts[0] - counts[1]) > 0.03 * counts[0]
    # And back again.
    changed.set_sensor(30_000 + span_us, SensorControl())
    begin_us = 50_000 + span_us
    back = [events_between(one, begin_us, begin_us + span_us) for one in (before, changed)]
    assert back[1] == pytest.approx(back[0], rel=0.01)


def test_a_threshold_lowered_below_what_a_pixel_has_seen_fires_at_once():
    pixels = PixelArray(1, 9, QUIET, SEED)
    every, row = np.arange(1), np.array([4.0])
    # 20 % more light at the centre: below the threshold of 25 %.
    pixels.relight(0, every, row, np.array([0.2 / QUIET.amplitude]))
    pixels.run_until(50_000)
    assert pixels.take(50_000).size == 0
    pixels.change(50_000, replace(QUIET, threshold_on=0.15))
    pixels.run_until(60_000)
    keys = pixels.take(60_000)
    assert set((keys >> 22).tolist()) == {50_100}
    assert set((keys >> 11 & 1).tolist()) == {1}
    assert 4 in (keys >> 12 & 0x3FF)


def test_a_dead_time_that_has_begun_ends_when_it_was_to_end():
    every, row, full = np.arange(1), np.array([0.0]), np.array([1.0])

    def second_event_us(changed: bool) -> int:
        pixels = PixelArray(1, 1, QUIET, SEED)
        pixels.relight(0, every, row, full)
        pixels.run_until(400)
        if changed:
            pixels.change(400, replace(QUIET, refractory_us=5.0))
        pixels.relight(600, every, row, 0.0 * full)
        pixels.run_until(20_000)
        return int(np.sort(pixels.take(30_000) >> 22)[1])

    assert second_event_us(changed=True) == second_event_us(changed=False)


def test_leaks_go_on_at_the_new_rate():
    print(f"seed {SEED}")
    pixels = PixelArray(200, 100, PixelParameters(leak_hz=20.0), SEED)
    for until_us, rate_hz in ((1_000_000, 20.0), (2_000_000, 5.0)):
        pixels.change(until_us - 1_000_000, PixelParameters(leak_hz=rate_hz))
        pixels.run_until(until_us)
        count = pixels.take(until_us).size
        assert abs(count - 20_000 * rate_hz) < 4 * np.sqrt(20_000 * rate_hz)


def test_the_past_is_refused_and_the_future_can_be_replaced():
    changed, plain = world(), world()
    changed.set_sensor(30_000, SensorControl(Biases(diff_on=100)))
    changed.set_sensor(20_000, SensorControl())
    assert changed.advance(60_000) == plain.advance(60_000)
    with pytest.raises(ArgumentError, match="60000 us are simulated"):
        changed.set_sensor(59_999, SensorControl())


def test_streams_stay_complete():
    made = controlled()
    decoder = Decoder(64, 720)
    events = decoder.decode(made.advance(140_000))
    assert len(events) == made.events
    assert np.all(np.diff(events.t) >= 0)
    counters = decoder.counters
    assert counters.broken_continuations == 0
    assert counters.erc_events_in - counters.erc_events_out == made.rate_dropped
