"""Effects of the world, each against the optics that it follows."""

import math
from dataclasses import replace

import numpy as np
import pytest

from eschorty_ros.core.base.errors import ArgumentError
from eschorty_ros.core.clocks import MotionPlan
from eschorty_ros.core.evt3 import Decoder
from eschorty_ros.core.modulation import Modulation
from eschorty_ros.core.optics import load_calibration
from eschorty_ros.simulation.pixels import preset
from eschorty_ros.simulation.scenes import Plane, Steps
from eschorty_ros.simulation.world import Effects, World

SEED = 4
BUILD = replace(load_calibration("config_3"), columns=96, principal_column=None)
MODEL = BUILD.model()
QUIET = replace(preset("paper"), noise=0.0, threshold_mismatch=0.0)
RANGE_MM = 1320.0


def rest(scene=None, text="none", stage_mm=0.0, background_hz=0.0, until_us=200_000):
    """Return the world after a rest before a scene, its events, and what the decoder counted."""
    print(f"seed {SEED}, {text}")
    effects = Effects.parse(text)
    world = World(scene or Plane(RANGE_MM), BUILD, QUIET, SEED, background_hz, effects=effects)
    world.set_laser(0, True, Modulation(70.0, on_edge_us=0))
    world.set_stage(MotionPlan(0, stage_mm))
    decoder = Decoder(96, 720)
    return world, decoder.decode(world.advance(until_us)), decoder.counters


def rows_lit(events) -> int:
    return int(np.ptp(events.y)) + 1


def half_rows(contrast: float) -> float:
    """Rows from the centre at which a line of this peak contrast stops to cause events."""
    least = math.expm1(QUIET.threshold_on)
    return QUIET.sigma_rows * math.sqrt(2.0 * math.log(contrast / least))


def blur_sigma_rows(beside_mm: float) -> float:
    """Standard deviation of the blur of a point off the plane in focus, from the lens equation."""
    theta, tilt = math.radians(BUILD.theta_deg), math.asin(MODEL.tilt_sine)
    focal = BUILD.focal_length_mm
    lens_mm = focal * (1.0 / math.tan(theta) + 1.0 / math.tan(tilt)) * math.sin(theta)
    pupil_mm = focal / BUILD.f_number
    disc_mm = pupil_mm * beside_mm / (lens_mm + beside_mm) * MODEL.k_mm / RANGE_MM
    return 0.25 * disc_mm / (BUILD.pixel_um * 1e-3 * math.cos(tilt))


def test_a_world_without_effects_is_the_same_byte_by_byte() -> None:
    plain = World(Steps(), BUILD, seed=SEED)
    named = World(Steps(), BUILD, seed=SEED, effects=Effects(ghost_mm=20.0))
    for world in (plain, named):
        world.set_laser(0, True, Modulation(70.0, on_edge_us=0))
    assert plain.advance(50_000) == named.advance(50_000)


def test_ambient_light_narrows_the_line_and_adds_background() -> None:
    light = 1.0 + 0.5 * QUIET.amplitude
    _, events, _ = rest(text="ambient=0.5")
    assert rows_lit(events) == pytest.approx(2.0 * half_rows(QUIET.amplitude / light), abs=2.0)
    far = Plane(3000.0)
    plain, ambient = (
        rest(far, text, background_hz=1.0)[1].t.size for text in ("none", "ambient=0.5")
    )
    assert ambient / plain == pytest.approx(light, rel=5.0 / math.sqrt(plain))


@pytest.mark.parametrize("range_mm", [900.0, 1320.0, 1900.0])
def test_brightness_falls_with_the_square_of_the_range(range_mm: float) -> None:
    _, events, _ = rest(Plane(range_mm), "falloff_mm=1320")
    contrast = QUIET.amplitude * (RANGE_MM / range_mm) ** 2
    assert rows_lit(events) == pytest.approx(2.0 * half_rows(contrast), abs=2.0)


def test_a_defocused_line_is_wide_and_dim() -> None:
    _, events, _ = rest(text="defocus_mm=40")
    wide = math.hypot(QUIET.sigma_rows, blur_sigma_rows(40.0)) / QUIET.sigma_rows
    assert wide > 1.1
    assert rows_lit(events) == pytest.approx(
        2.0 * wide * half_rows(QUIET.amplitude / wide), abs=2.0
    )
    row = float(MODEL.row(RANGE_MM))
    assert events.y.mean() == pytest.approx(row, abs=0.3)


@pytest.mark.parametrize("beside_mm", [16.0, -12.0])
def test_a_ghost_lies_where_the_lens_images_it(beside_mm: float) -> None:
    _, events, _ = rest(text=f"ghost=0.4,ghost_mm={beside_mm}")
    row = float(MODEL.row(RANGE_MM))
    # The ray to the lens meets the sheet nearer than the ghost, or farther.
    along_mm, lens_mm = MODEL.pupil_mm
    nearer_mm = (RANGE_MM - along_mm) * beside_mm / (lens_mm + beside_mm)
    ghost_row = float(MODEL.row(RANGE_MM - nearer_mm))
    assert abs(ghost_row - row) > 40.0
    ghost = events.y[np.abs(events.y - ghost_row) < 20.0]
    assert ghost.mean() == pytest.approx(ghost_row, abs=0.3)
    wide = math.hypot(QUIET.sigma_rows, blur_sigma_rows(beside_mm)) / QUIET.sigma_rows
    assert np.ptp(ghost) + 1 == pytest.approx(
        2.0 * wide * half_rows(0.4 * QUIET.amplitude / wide), abs=2.0
    )


def test_a_step_hides_what_is_behind_it_on_the_side_of_the_camera() -> None:
    # A level of 1220 mm up to 50 mm, 1320 mm from there on.
    scene = Steps(RANGE_MM, (0.0,), (-100.0, 0.0), 50.0)
    along_mm, lens_mm = MODEL.pupil_mm
    shadow_mm = 100.0 * lens_mm / (RANGE_MM - along_mm)
    assert 10.0 < shadow_mm < 20.0
    row = float(MODEL.row(RANGE_MM))
    line_mm = half_rows(QUIET.amplitude) / float(MODEL.rows_per_mm_off_sheet(RANGE_MM))
    for stage_mm, seen in (
        (50.0 + shadow_mm + line_mm + 0.5, True),
        (50.0 + shadow_mm - line_mm - 0.5, False),
    ):
        world, events, _ = rest(scene, "occlusion=1", stage_mm)
        assert (events.t.size > 0) == seen
        assert (world.truth.size > 0) == seen
        if seen:
            assert events.y.mean() == pytest.approx(row, abs=0.3)
    # The other way round nothing is hidden: the lens is on that side.
    mirrored = Steps(RANGE_MM, (0.0,), (0.0, -100.0), 50.0)
    _, events, _ = rest(mirrored, "occlusion=1", 50.0 - line_mm - 0.5)
    assert events.y.mean() == pytest.approx(row, abs=0.3)


def test_a_slow_readout_delays_the_rows_one_by_one() -> None:
    row_time_us = 100.0
    last_us = []
    for text in ("none", f"row_time_us={row_time_us}"):
        _, events, _ = rest(text=text)
        since_us = events.t[events.p == 1] % (1e6 / 70.0)
        last_us.append(float(np.percentile(since_us, 98.0)))
    queue_us = rows_lit(events) * row_time_us
    assert last_us[1] - last_us[0] == pytest.approx(queue_us, rel=0.2)
    # All events of a row leave together.
    assert len(np.unique(events.t)) < events.t.size / 20


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("foo=1", "effects: there is none named 'foo'; choose of ambient, .*, row_time_us$"),
        ("ambient=-1", "effects: ambient is -1"),
        ("ambient=much", "ambient is 'much'; write a number"),
        ("falloff_mm=0", "falloff_mm"),
        ("ghost=0.4", "give the ghost a distance"),
        ("occlusion=2", "occlusion is 2"),
        ("row_time_us=0", "row_time_us"),
        ("ambient=1}", "effects is 'ambient=1}'; write NAME=VALUE,... with each name once"),
        ("ambient=1,ambient=2", "each name once"),
        ("ambient", "effects is 'ambient'; write NAME=VALUE"),
        ("falloff_mm=", "effects is 'falloff_mm='; write NAME=VALUE"),
    ],
)
def test_effects_that_cannot_be_are_refused(text: str, words: str) -> None:
    with pytest.raises(ArgumentError, match=words):
        Effects.parse(text)
